# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
OGBench's cube-double as a World: a UR5e, and two cubes to be pushed between four unseen walls.

Its robot stands at the far side of the table: our origin is its (0.425, 0, 0), turned so that x is
to the right and y away from the camera. Walls, bounds of the gripper, physics and the signal of
success are its own. Start and target places are given to it, so that the order matters: one cube
stands before the wall in front, where the other shall be, and shall go along that wall. Whoever
begins with the other pushes it to the wall, where the gripper cannot get behind it any more.
"""

from dataclasses import replace
from typing import Any
import warnings

import mujoco
import numpy as np
from sim_bridge.gym_world import GymWorld
from sim_bridge.pushes import Route
from sim_bridge.tasks.motions import direction
from sim_bridge.world.camera import Camera, load_triton, Renderer
from tap_ros.base.contract import (
    CAMERA_SIZE,
    CONTROL_PERIOD,
    LIFTED,
    ROBOT_MASK_ARM,
    ROBOT_MASK_FREE,
    ROBOT_MASK_HAND,
)
from tap_ros.base.errors import ConfigError, SceneError

TASK = 'cube-double'
ORIGIN = np.array([0.425, 0.0, 0.0])  # m, of our frame in OGBench's; on the table
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # theirs to ours
TIPS = np.array([0.0, 0.0, 0.02])  # m, from fingertips that just clear the table to its place
CAMERA = Camera(64, 64, tilt=0.54, fovy=20.0, position=(0.0, -0.74, 1.21))  # in our frame
GAIN = 1.5  # of what is asked for in a step over the way to where the fingertips shall be
# OGBench's own limit of commands is less than the planner's, above all in coming down: then time
# stands still, so that a hand that is late is not taken for one that stands upon something.
MORE, CLOSE = 3, 0.005  # steps at most; m
# Where cubes are put, ours, m and rad. The front wall's inside is at y = -0.2.
EDGE = (-0.14, -0.12)  # y, of the cube that stands before the wall
AWAY = (1.7, 1.85)  # between the way out to the wall and the way of that cube
OUTWARDS = 0.35  # largest, between it and the way of the other cube, which ends where that stood
WAY, NEAR, WIDE = 0.18, 0.01, 0.22  # m: ways; that end so near; |x|
HAND = (0.1, 0.16)  # m, from the other cube to the hand when it begins
SETTLING = 30  # steps in which the hand goes there


class CubeDouble(GymWorld):
    """
    The World 'ogbench'.

    :param task: 'cube-double'.
    :param image_size: width and height of the pictures in pixels.
    :raises ConfigError: if OGBench is not installed.
    :raises SceneError: for another task.
    """

    object_names = ('object_0', 'object_1')

    def __init__(self, task: str = TASK, image_size: int = CAMERA_SIZE) -> None:
        if task != TASK:
            raise SceneError(f'task {task!r} is unknown; valid: {TASK}')
        self.task_name, self.env = task, _make_env()
        with warnings.catch_warnings(action='ignore'):  # of its spaces
            self.env.reset(seed=0)  # it makes the model
        self.camera = replace(CAMERA, width=image_size, height=image_size)
        model = self.env.model
        eye = model.cam('front')
        eye.pos[:], eye.fovy[:] = TURN.T @ CAMERA.position + ORIGIN, CAMERA.fovy
        eye.quat[:] = replace(CAMERA, turn=np.pi / 2).quaternion
        self._renderer, self._labels = Renderer(model, image_size, image_size), _labels(model)

    def begin(self, seed: int) -> None:
        """Begin the scene of a seed; the hand is beside the cube that has to wait."""
        rng = np.random.default_rng(seed)
        starts, goals, hand = draw_scene(rng)
        self.order = rng.permutation(2)  # the cube before the wall is the first of it
        back = np.argsort(self.order)
        starts, goals = (np.column_stack([places[back], (0.02, 0.02)]) @ TURN + ORIGIN
                         for places in (starts, goals))
        with warnings.catch_warnings(action='ignore'):
            self.env.reset(seed=seed, options={'task_info': {
                'task_name': TASK, 'init_xyzs': starts, 'goal_xyzs': goals}})
        self.env.data.qacc_warmstart[:] = 0  # what its goal left, by steps at random
        for _ in range(SETTLING):
            self._act(np.append(hand, LIFTED), 0.0)

    def move(self, target: np.ndarray, opening: float) -> None:
        """Bring the fingertips to (3,) m, and a gripper's opening, 0 to 1; see MORE."""
        least = round(CONTROL_PERIOD / self.env.control_timestep())
        for step in range(least + MORE):
            if step >= least and np.linalg.norm(target - self.gripper()[:3]) < CLOSE:
                break
            self._act(target, opening)

    def _act(self, target: np.ndarray, opening: float) -> None:
        """Take a step towards a place; the fingers stay across the way from the robot."""
        seen = self.env.compute_ob_info()
        way = TURN.T @ (target - self.gripper()[:3])
        wanted = np.array([*GAIN * way, -seen['proprio/effector_yaw'][0],
                           1 - opening - seen['proprio/gripper_opening'][0]])
        self.env.step(self.env.normalize_action(wanted))

    def gripper(self) -> np.ndarray:
        """Return (4,): the fingertips' place in m and the opening from 0 to 1."""
        seen = self.env.compute_ob_info()
        return np.append(to_ours(seen['proprio/effector_pos']) - TIPS,
                         1 - seen['proprio/gripper_opening'])

    def object_poses(self) -> np.ndarray:
        """Return (2, 7): place in m, quaternion in OGBench's frame of each cube."""
        found = [self.env.data.joint(f'object_joint_{i}').qpos for i in range(2)]
        return np.stack([np.concatenate([to_ours(q[:3]), q[[4, 5, 6, 3]]]) for q in found])

    def goal_places(self) -> np.ndarray:
        """Return (2, 3) m, where the cubes shall be."""
        return np.stack([to_ours(self.env.data.body(f'object_target_{i}').xpos)
                         for i in range(2)])

    def route(self) -> Route:
        """Return the cubes and their goals in the right order."""
        return [(int(k), self.goal_places()[k, :2]) for k in self.order]

    def succeeds(self) -> bool:
        """Return whether OGBench says that both cubes are where they shall be, within 4 cm."""
        return all(self.env._compute_successes())

    def draw(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture and the robot mask."""
        self._renderer.update_scene(self.env.data, 'front')
        image, ids = self._renderer.render(), self._renderer.numbers()
        geom = ids[..., 1] == mujoco.mjtObj.mjOBJ_GEOM
        return image, np.where(geom, self._labels[ids[..., 0]], ROBOT_MASK_FREE).astype(np.uint8)

    def solve(self) -> None:
        """Put the cubes to their goals, as OGBench itself does to show a goal."""
        for i, place in enumerate(self.goal_places()):
            self.env.data.joint(f'object_joint_{i}').qpos[:3] = TURN.T @ place + ORIGIN
        mujoco.mj_forward(self.env.model, self.env.data)

    def close(self) -> None:
        """Free the renderer and the environment."""
        self._renderer.close()
        self.env.close()


def draw_scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return starts and goals (2, 2) m of the cube before the wall and the other, hand (2,)."""
    starts, goals, out = np.empty((2, 2)), np.empty((2, 2)), -np.pi / 2
    while True:
        starts[0] = rng.uniform(-WIDE, WIDE), rng.uniform(*EDGE)
        goals[0] = starts[0] + WAY * direction(out + rng.choice([-1, 1]) * rng.uniform(*AWAY))
        goals[1] = starts[0] + rng.uniform(-NEAR, NEAR, 2)
        starts[1] = goals[1] - WAY * direction(out + rng.uniform(-OUTWARDS, OUTWARDS))
        angle = rng.uniform(-np.pi, np.pi)
        hand = starts[1] + rng.uniform(*HAND) * direction(angle)
        if (np.abs([*starts, *goals, hand])[:, 0].max() < WIDE and hand[1] > starts[1, 1]
                and np.linalg.norm(goals[0] - starts[1]) > 0.1):
            return starts, goals, hand


def to_ours(place: np.ndarray) -> np.ndarray:
    """Return a place (3,) of OGBench's frame in ours, m."""
    return TURN @ (np.asarray(place, np.float64) - ORIGIN)


def _make_env() -> Any:
    """Return the environment."""
    load_triton()  # OGBench draws, too
    try:
        from ogbench.manipspace.envs.cube_env import CubeEnv
    except ModuleNotFoundError as error:
        raise ConfigError(
            'world ogbench: OGBench is not installed; type `pip install --no-deps -r '
            'requirements-worlds.txt` in the folder of tap_ros') from error
    return CubeEnv('double', permute_blocks=False, terminate_at_goal=False, visualize_info=False)


def _labels(model: mujoco.MjModel) -> np.ndarray:
    """Return what each geom is in a robot mask, uint8 (G,)."""
    kinds = {'ur5e/robotiq/': ROBOT_MASK_HAND, 'ur5e/': ROBOT_MASK_ARM, '': ROBOT_MASK_FREE}
    return np.array([next(kind for prefix, kind in kinds.items()
                          if model.body(body).name.startswith(prefix))
                     for body in model.geom_bodyid], np.uint8)
