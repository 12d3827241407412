# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Meta-World's environments as Worlds.

Its table lies between robot and camera: our origin is its (0, 0.65, 0), turned by half a turn, so
that x is to the right and y away from the camera, which stands opposite the robot.
"""

from dataclasses import replace
from typing import Any
import warnings

import mujoco
import numpy as np
from sim_bridge.demonstrations import demonstrate, Demonstration
from sim_bridge.gym_world import GymWorld
from sim_bridge.world.camera import Camera, Renderer
from sim_bridge.world.gap import Gap
from tap_ros.base.contract import (
    CAMERA_SIZE,
    CONTROL_PERIOD,
    ROBOT_MASK_ARM,
    ROBOT_MASK_FREE,
    ROBOT_MASK_HAND,
)
from tap_ros.base.errors import ConfigError, SceneError
from tap_ros.base.text import meant

ORIGIN = np.array([0.0, 0.65, 0.0])  # m, of our frame in Meta-World's; on the table
TURN = np.array([-1.0, -1.0, 1.0])  # half a turn about the vertical
CAMERA = Camera(64, 64, tilt=0.54, fovy=24.0, position=(0.0, -0.78, 1.21))  # in our frame
# From the robot's side: what it works at hides little.
SIDE = replace(CAMERA, tilt=0.87, fovy=42.0, position=(0.85, 0.5, 0.86), turn=2.1)
GAIN = 12.0  # of the command over the gap to where the fingertips shall be, 1/m
LEAD = 0.06  # m, by which what pulls the hand may be ahead of one that is blocked
SOLVING_STEPS = 400  # environment steps that the scripted policy has at most
FURTHER_STEPS = 60  # of it after the success, whose bounds are wide
LEAVING = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.12), (0.0, 0.1, 0.0))  # m, of the open hand, then
# Places of our frame, m, by which the object has to go, as a wall stands in the way.
WAYS: dict[str, tuple[tuple[float, float], ...]] = {'push-wall-v3': ((0.12, 0.0), (0.12, -0.2))}
REACH = np.array([[-0.35, 0.45, 0.12], [0.35, 0.8, 0.4]])  # m, in their frame


class MetaWorld(GymWorld):
    """
    The World 'metaworld': one environment with one object.

    :param task: its name, such as 'push-v3'.
    :param image_size: width and height of the pictures in pixels.
    :raises ConfigError: if Meta-World is not installed.
    :raises SceneError: for an unknown task.
    """

    object_names: tuple[str, ...] = ('object_0',)
    steps, reach = 4, REACH  # of demonstrations

    def __init__(self, task: str = 'push-v3', image_size: int = CAMERA_SIZE) -> None:
        self.task_name, self.ways = task, WAYS.get(task, ())
        self.env, self.policy = make_env(task)
        self.camera = replace(CAMERA, width=image_size, height=image_size)
        model = self.env.model
        for name, camera in (('corner', CAMERA), ('corner3', SIDE)):
            eye = model.cam(name)
            eye.pos[:], eye.fovy[:] = np.array(camera.position) * TURN + ORIGIN, camera.fovy
            eye.quat[:] = replace(camera, turn=camera.turn + np.pi).quaternion
        self._renderer = Renderer(model, image_size, image_size)
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0  # the goal is drawn as a site
        self._labels = _labels(model)
        self._movable, self._gap = _movable(model), Gap(model, 'base')
        self.slides = _slides(model)
        self.step_ns, self.scale = round(1e9 * self.env.dt), self.env.action_scale * TURN
        self._seen: np.ndarray = np.empty(0)
        self._begun = 0  # the seed of the scene
        self._info: dict[str, Any] = {}

    def begin(self, seed: int) -> None:
        """Begin the scene of a seed."""
        self._begun = seed
        self.env.seed(seed)
        self._seen, self._info = self.env.reset(seed=seed)

    def move(self, target: np.ndarray, opening: float) -> None:
        """Move the fingertips to a place (3,) m of our frame, in one control period."""
        grip, last = 1 - 2 * opening, round(CONTROL_PERIOD / self.env.dt) - 1
        pulled, pulling = self.env.data.body('hand').xpos, self.env.data.mocap_pos[0]
        for step in range(last + 1):
            pulling[:] = np.clip(pulling, pulled - LEAD, pulled + LEAD)
            action = np.append(np.clip(GAIN * (target - self.gripper()[:3]) * TURN, -1, 1), grip)
            if step == last:
                self.act(action)
            else:  # without rewards and what is seen, which take more time than the physics
                self.env.set_xyz_action(action[:3])
                self.env.do_simulation([grip, -grip], n_frames=self.env.frame_skip)

    def act(self, action: np.ndarray) -> None:
        """Take one step of the environment with its own action (4,), each in [-1, 1]."""
        self._seen, _, _, _, self._info = self.env.step(
            np.clip(action, -1, 1).astype(np.float32))

    def gripper(self) -> np.ndarray:
        """Return (4,): the fingertips' place in m and the opening from 0 to 1."""
        return np.append(to_ours(self.env.tcp_center), np.clip(self._seen[3], 0, 1))

    def object_poses(self) -> np.ndarray:
        """Return (1, 7): the object's place in m, its quaternion in the environment's frame."""
        return np.concatenate([to_ours(self._seen[4:7]), self._seen[7:11]])[None]

    def goal_places(self) -> np.ndarray:
        """Return (1, 3) m, where the object shall be."""
        return to_ours(self.env._target_pos)[None]

    def succeeds(self) -> bool:
        """Return whether the environment says that it is solved."""
        return bool(self._info.get('success', 0) >= 1)

    def draw(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture, without the marker of the goal, and the robot mask."""
        image, ids = self._draw('corner'), self._renderer.numbers()
        geom = ids[..., 1] == mujoco.mjtObj.mjOBJ_GEOM
        return image, np.where(geom, self._labels[ids[..., 0]], ROBOT_MASK_FREE).astype(np.uint8)

    def _draw(self, camera: str) -> np.ndarray:
        self._renderer.update_scene(self.env.data, camera, self._option)
        return self._renderer.render()

    def solve(self) -> None:
        """
        Let Meta-World's scripted policy act until it is solved; then the hand lets go and leaves.

        :raises SceneError: if the environment does not say that it is solved.
        """
        for further in (FURTHER_STEPS, 0):  # some scripts do not hold what they have brought
            for _ in range(SOLVING_STEPS):
                self.act(self.command())
                if self.succeeds():
                    break
            for _ in range(further):
                self.act(self.command())
            place = self.gripper()[:3]
            for way in np.cumsum(LEAVING, axis=0):
                self.move(place + way, 1.0)
            if self.succeeds():
                return
            self.begin(self._begun)
        raise SceneError(f'task {self.task_name}: the scripted policy does not solve this scene; '
                         'take another seed')

    def demonstrate(self, seed: int, num_frames: int = 0, pushes: str = '') -> Demonstration:
        """Push as pushes.py says; without a word for it let the scripted policy act."""
        return super().demonstrate(seed, pushes=pushes) if pushes else demonstrate(
            self, seed, num_frames)

    def command(self) -> np.ndarray:
        """Return what the scripted policy commands now, (4,) in [-1, 1]."""
        with warnings.catch_warnings(action='ignore'):  # it commands more than is allowed
            action = self.policy.get_action(self._seen)
        return np.clip(np.asarray(action, np.float64), -1, 1)

    def hand(self) -> np.ndarray:
        """Return where the hand is, (3,) m in Meta-World's frame."""
        return np.array(self._seen[:3])

    def movable(self) -> np.ndarray:
        """Return where all is that is not the robot, without orientations."""
        return np.array(self.env.data.qpos[self._movable])

    def gap(self) -> float:
        """Return how far the robot is from what is not the robot and moves, m."""
        return self._gap(self.env.data)

    def picture(self) -> np.ndarray:
        """Return what a camera beside the robot sees."""
        return self._draw('corner3')

    def close(self) -> None:
        """Free the renderer and the environment."""
        self._renderer.close()
        self.env.close()


def make_env(task: str) -> tuple[Any, Any]:
    """
    Make an environment of Meta-World that draws its scene from the seed of reset.

    :param task: its name.
    :return: the environment, and the scripted policy that its authors ship for it.
    :raises ConfigError: if Meta-World is not installed.
    :raises SceneError: for an unknown task.
    """
    try:
        from metaworld import sawyer_xyz_env
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS
        from metaworld.policies import ENV_POLICY_MAP
    except ModuleNotFoundError as error:
        raise ConfigError(
            'world metaworld: Meta-World is not installed; type `pip install --no-deps -r '
            'requirements-worlds.txt` in the folder of tap_ros') from error
    if task not in ALL_V3_ENVIRONMENTS:
        raise SceneError(f'task {task!r} is unknown; {meant(task, ALL_V3_ENVIRONMENTS)}valid: '
                         + ', '.join(ALL_V3_ENVIRONMENTS))
    # Meta-World 3.1 writes rows of 11 numbers; MuJoCo 4 has 12.
    setattr(sawyer_xyz_env.SawyerMocapBase, 'reset_mocap_welds', _reset_mocap_welds)  # noqa: B010
    env = ALL_V3_ENVIRONMENTS[task]()
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    env._partially_observable = False
    vars(env).pop('sawyer_observation_space', None)  # cached, with the goal clipped to 0
    env.max_path_length = 10 ** 9
    policy: Any = ENV_POLICY_MAP[task]
    return env, policy()


def to_ours(place: np.ndarray) -> np.ndarray:
    """Return a place (3,) of Meta-World's frame in ours, m."""
    return (np.asarray(place, np.float64) - ORIGIN) * TURN


def _reset_mocap_welds(self: Any) -> None:
    """Let the hand follow its mocap body without an offset."""
    welds = self.model.eq_type == mujoco.mjtEq.mjEQ_WELD
    self.model.eq_data[welds, :11] = (0, 0, 0, 0, 0, 0, -1, 0, 0, 0, 5)


def _labels(model: mujoco.MjModel) -> np.ndarray:
    """Return what each geom is in a robot mask, uint8 (G,)."""
    robot, hand = model.body_rootid == model.body('base').rootid, model.body('hand').id
    labels = np.where(robot, ROBOT_MASK_ARM, ROBOT_MASK_FREE).astype(np.uint8)
    labels[hand] = ROBOT_MASK_HAND
    for body in range(hand + 1, model.nbody):  # parents come first
        if labels[model.body_parentid[body]] == ROBOT_MASK_HAND:
            labels[body] = ROBOT_MASK_HAND
    return labels[model.geom_bodyid]


def _slides(model: mujoco.MjModel) -> bool:
    """Return whether something that is not the robot can be pushed about on the table."""
    kinds = model.jnt_type[model.body_rootid[model.jnt_bodyid] != model.body('base').rootid]
    return bool((kinds == mujoco.mjtJoint.mjJNT_FREE).any()
                or (kinds == mujoco.mjtJoint.mjJNT_SLIDE).sum() > 1)


def _movable(model: mujoco.MjModel) -> np.ndarray:
    """Return where positions of what is not the robot stand in qpos, int (Q,)."""
    free = model.body_rootid[model.jnt_bodyid] != model.body('base').rootid
    return np.concatenate([
        np.arange(3 if kind == mujoco.mjtJoint.mjJNT_FREE else 1) + first
        for kind, first in zip(model.jnt_type[free], model.jnt_qposadr[free])])
