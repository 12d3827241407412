# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo table: gripper, objects and a camera, without a task. Knows nothing of ROS."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import replace

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.world.camera import OneCamera
from sim_bridge.world.looks import choose_appearance, DEFAULT_LOOK, get_look, USUAL
from sim_bridge.world.protocol import clip_action, Observation
from sim_bridge.world.scene import (
    build_scene,
    FINGER_TRAVEL,
    HALF_HEIGHT,
    ObjectShape,
    TIMESTEP,
)
from sim_bridge.world.studio import Studio
from tap_ros.base.contract import (
    CAMERA_SIZE,
    CONTROL_PERIOD,
    object_names,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
)
from tap_ros.base.errors import KinematicsError, SceneError
from tap_ros.robots.arm import DEFAULT_ARM, get_arm

SUBSTEPS = round(CONTROL_PERIOD / TIMESTEP)
RAMP_SUBSTEPS = SUBSTEPS - 4  # the target moves evenly, then the servo has time to catch up
SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)  # of a move, to which an arm shortens what is too fast
BENT = 0.1  # share of the fingers' travel that they may be beyond their ends
GRIPPER_RANGE = 0.4  # m, |x| and |y| of the gripper at the start
GRIPPER_HEIGHT = 0.14  # m, highest start of the gripper
GRIPPER_MARGIN = 0.16  # m between the gripper and any object origin at the start
OBSERVER_SIZE = 384  # pixels of the picture for people
OBJECT_QPOS_START = 5  # after gripper x, y, z and two fingers; of velocities, too


def ramp_controls(target: np.ndarray, actions: np.ndarray,
                  low: Sequence[float] = WORKSPACE_LOW, high: Sequence[float] = WORKSPACE_HIGH,
                  ) -> tuple[np.ndarray, np.ndarray]:
    """
    Turn actions into servo targets for every physics step.

    :param target: (4,) the present target: x, y, z, opening.
    :param actions: (..., T, 4) actions within the limits.
    :param low: (3,) m, where the gripper may be, least; high: greatest.
    :return: controls (..., T * SUBSTEPS, 5) and the targets after each action (..., T, 4).
    """
    targets = np.empty(actions.shape)
    targets[..., 3] = actions[..., 3]
    position = np.broadcast_to(target[:3], actions[..., 0, :3].shape)
    for t in range(actions.shape[-2]):
        position = np.clip(position + actions[..., t, :3], low, high)
        targets[..., t, :3] = position
    first = np.broadcast_to(target, targets[..., :1, :].shape)
    before = np.concatenate([first, targets[..., :-1, :]], axis=-2)
    share = np.minimum(np.arange(1, SUBSTEPS + 1) / RAMP_SUBSTEPS, 1)[:, None]
    path = before[..., None, :] + share * (targets - before)[..., None, :]  # (..., T, S, 4)
    fingers = path[..., 3:] * FINGER_TRAVEL
    controls = np.concatenate([path[..., :3], fingers, fingers], axis=-1)
    return controls.reshape(*actions.shape[:-2], -1, 5), targets


def objects_in(states: np.ndarray, model: mujoco.MjModel) -> np.ndarray:
    """Return (..., K, 7) x, y, z in m, quaternion w, x, y, z in states (..., S) of the physics."""
    poses = states[..., 1 + OBJECT_QPOS_START:1 + model.nq]  # after the time
    return poses.reshape(*poses.shape[:-1], -1, 7)


def upright(objects: np.ndarray) -> np.ndarray:
    """Return the cosines (...) of tilts; objects (..., 7) as objects_in."""
    return 1 - 2 * (objects[..., 4] ** 2 + objects[..., 5] ** 2)


class Table(OneCamera):
    """
    A table with a gripper, objects and a camera; see simulator.Simulator.

    :param gripping: the hand is one that grips, and the camera near.
    :ivar goal_poses: (K, 7) where the objects shall be, as object_poses.
    :ivar object_names: K names, in the order of their poses.
    :ivar seed: of the scene.
    """

    goal_poses: np.ndarray

    def __init__(self, image_size: int = CAMERA_SIZE, gripping: bool = False,
                 look: str = DEFAULT_LOOK, appearance: str = 'usual',
                 arm: str = DEFAULT_ARM) -> None:
        self.look, self.arm = get_look(look), get_arm(arm)
        if not 16 <= image_size <= 1024:
            raise SceneError(f'image_size {image_size}: expected 16 to 1024 pixels')
        choose_appearance(appearance, 0)  # refuses what there is not
        self._appearance, self._gripping = appearance, gripping
        self._usual_camera = self.look.camera(gripping, image_size, image_size)
        self.camera = self._usual_camera
        self._rollout = mujoco.rollout.Rollout(nthread=0)
        self._renderer: Studio | None = None
        self._observer: Studio | None = None
        self._worn = USUAL  # the appearance of the present scene

    def load(self, shapes: Sequence[ObjectShape], poses: np.ndarray, gripper: np.ndarray,
             seed: int) -> None:
        """
        Put objects and the gripper at their start.

        :param shapes: K shapes.
        :param poses: (K, 7) x, y, z in m, quaternion x, y, z, w.
        :param gripper: (3,) m.
        :param seed: of the scene.
        """
        self.seed, self.object_names = seed, object_names(len(shapes))
        self.model = build_scene(shapes, self._gripping)
        self.data, self._scratch = mujoco.MjData(self.model), mujoco.MjData(self.model)
        if self._renderer is None:
            self._renderer = Studio(self._usual_camera, self.arm, self.look.arm)
        self._worn = choose_appearance(self._appearance, seed)
        self.camera = self._renderer.use(self.model, self._worn)
        self.target = np.append(gripper, 0.0)
        self.place(poses, gripper)

    def photograph(self, object_poses: np.ndarray, gripper: np.ndarray | None = None,
                   hide_arm: bool = False) -> Observation:
        """
        Observe the objects at other places; nothing moves.

        :param object_poses: (K, 7) x, y, z in m, quaternion x, y, z, w.
        :param gripper: (3,) where the arm is to be seen, m, or (4,) with its opening; by default
            closed and somewhere beside the objects, drawn from the scene's seed.
        :param hide_arm: leave the arm out of the picture.
        :return: Observation.
        """
        if gripper is None:
            gripper = self._beside(object_poses[:, :2])
        with self.unmoved():
            self.place(object_poses, gripper)
            return self.observe(hide_arm)

    @contextmanager
    def unmoved(self) -> Iterator[None]:
        """Put everything back, to the bit, when the block ends."""
        before = copy(self.data)
        try:
            yield
        finally:
            mujoco.mj_copyData(self.data, self.model, before)

    def step(self, action: ArrayLike) -> Observation:
        """
        Act for one control period.

        :param action: (4,) displacement x, y, z in m, limited to ACTION_LIMIT, to half of it if
            the arm is slow, and to the workspace, and gripper opening from 0 (closed) to 1.
        :return: Observation.
        :raises SceneError: for another shape, values that are not finite, or what the arm
            cannot do; then nothing moves.
        """
        controls, self.target = self._ramp(action)
        for control in controls:
            self.data.ctrl[:] = control
            mujoco.mj_step(self.model, self.data)
        return self.observe()

    def check_action(self, action: ArrayLike) -> None:
        """Raise SceneError, as step does, for what cannot be done; nothing moves."""
        self._ramp(action)

    def _ramp(self, action: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the servo targets of an action (SUBSTEPS, 5) and the last one (4,)."""
        action, arm = clip_action(action), self.arm
        before = arm.joints_at(self.target)
        for share in SHARES:
            controls, targets = ramp_controls(
                self.target, action[None] * (share, share, share, 1), arm.low, arm.high)
            try:
                arm.check_motion(before, arm.joints_at(targets[0]), CONTROL_PERIOD)
                break
            except KinematicsError:
                if share == SHARES[-1]:
                    raise
        return controls, targets[0]

    def rollout(self, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """
        Return where N runs of the true physics lead; the table stays as it is.

        :param states: (N, S) as state; controls (N, T, 5) as of ramp_controls.
        :return: (N, T, S), after each physics step.
        """
        return self._rollout.rollout(self.model, self._scratch, states, controls)[0]

    def observe(self, hide_arm: bool = False) -> Observation:
        """Return the Observation of this moment."""
        assert self._renderer is not None, 'reset comes first'
        mujoco.mj_forward(self.model, self.data)
        poses = self.object_poses()
        # Contact can press the fingers beyond closed or open, as it bends those of a real hand.
        opening = np.clip(self.data.qpos[3:5].mean() / FINGER_TRAVEL, -BENT, 1 + BENT)
        image, mask, joints = self._renderer.render(self.data, hide_arm)
        return Observation(
            image=image,
            stamp_ns=round(self.data.time * 1e9),
            gripper=np.append(self.data.qpos[:3], opening).astype(np.float32),
            object_names=self.object_names,
            object_pixels=self.camera.project(poses[:, :3]).astype(np.float32),
            object_poses=poses, robot_mask=mask, arm_joints=joints)

    def observer_picture(self) -> np.ndarray:
        """Take the camera's picture with the whole arm, for people: uint8 (384, 384, 3) rgb."""
        if self._observer is None:
            camera = replace(self._usual_camera, width=OBSERVER_SIZE, height=OBSERVER_SIZE)
            self._observer = Studio(camera, self.arm, links=True, samples=1)
        self._observer.use(self.model, self._worn)
        return self._observer.render(self.data)[0]

    def object_poses(self) -> np.ndarray:
        """Return (K, 7): x, y, z in m, quaternion x, y, z, w."""
        poses = self.data.qpos[OBJECT_QPOS_START:].reshape(-1, 7)
        return poses[:, [0, 1, 2, 4, 5, 6, 3]].copy()

    def state(self) -> np.ndarray:
        """Return the full physics state, as mujoco.rollout takes it."""
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data, state, kind)
        return state

    def close(self) -> None:
        """Free the OpenGL contexts."""
        for renderer in (self._renderer, self._observer):
            if renderer is not None:
                renderer.close()
        self._renderer = self._observer = None

    def touching(self) -> bool:
        """Return whether a finger touches anything."""
        fingers = [self.model.geom(f'{side}_finger').id for side in ('left', 'right')]
        return bool(np.isin(self.data.contact.geom, fingers).any())

    def distances(self) -> np.ndarray:
        """Return (K,) metres from each object's origin to its goal, in three dimensions."""
        return np.linalg.norm(self.object_poses()[:, :3] - self.goal_poses[:, :3], axis=1)

    def place(self, object_poses: np.ndarray, gripper: np.ndarray) -> None:
        """Put objects at poses (K, 7) and the gripper at (3,), closed, or (4,), all at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:3] = gripper[:3]
        self.data.ctrl[:3] = gripper[:3]
        if len(gripper) == 4:
            self.data.qpos[3:5] = self.data.ctrl[3:5] = gripper[3] * FINGER_TRAVEL
        objects = self.data.qpos[OBJECT_QPOS_START:].reshape(-1, 7)
        objects[:] = object_poses[:, [0, 1, 2, 6, 3, 4, 5]]
        mujoco.mj_forward(self.model, self.data)

    def _beside(self, positions: np.ndarray) -> np.ndarray:
        """Draw a place of the gripper, (3,) m, that touches no object; positions (K, 2) m."""
        rng, arm = np.random.default_rng([self.seed, 7]), self.arm
        while True:
            place = rng.uniform(-GRIPPER_RANGE, GRIPPER_RANGE, 2)
            if np.linalg.norm(positions - place, axis=1).min() > GRIPPER_MARGIN and (
                    place >= arm.low[:2]).all() and (place <= arm.high[:2]).all():
                return np.append(place, rng.uniform(0, GRIPPER_HEIGHT))


def lifted(planar_poses: np.ndarray, height: float | np.ndarray = 0.0) -> np.ndarray:
    """Turn (K, 3) x, y, yaw into (K, 7) poses at a height, or (K,), above the table in metres."""
    level, half = np.zeros(len(planar_poses)), planar_poses[:, 2] / 2
    return np.column_stack([planar_poses[:, :2], level + (HALF_HEIGHT + height), level, level,
                            np.sin(half), np.cos(half)])
