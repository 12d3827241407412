# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A Gymnasium environment as a World.

What differs between environments stands in a Binding; metaworld.py has one.
"""

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.world.camera import Camera
from sim_bridge.world_protocol import Observation
from tap_ros.contract import ACTION_LIMIT, CONTROL_PERIOD, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.errors import SceneError


class Binding(Protocol):
    """
    One environment and what it means, in the frame and the units of contract.py.

    :ivar task_name: what the environment is about.
    :ivar object_names: of its K objects.
    :ivar camera: that takes its pictures.
    """

    task_name: str
    object_names: tuple[str, ...]
    camera: Camera

    def reset(self, seed: int) -> None:
        """Begin the scene of a seed."""

    def move(self, target: np.ndarray, opening: float) -> None:
        """
        Act for one control period.

        :param target: (3,) m, where the fingertips shall be at its end.
        :param opening: of the gripper, 0 to 1.
        """

    def gripper(self) -> np.ndarray:
        """Return (4,): the fingertips' place in m and the opening from 0 to 1."""

    def object_poses(self) -> np.ndarray:
        """Return (K, 7): place in m and quaternion x, y, z, w of each object."""

    def goal_places(self) -> np.ndarray:
        """Return (K, 3) m, where each object shall be."""

    def succeeds(self) -> bool:
        """Return the environment's own signal of success."""

    def draw(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture (H, W, 3) uint8, and its robot mask (H, W) as in contract.py."""

    def solve(self) -> None:
        """Bring the scene to its goal, so that a picture of it can be taken."""

    def close(self) -> None:
        """Free what the environment holds."""


class GymWorld:
    """
    A World made of two equal environments: one acts, the other shows the goal.

    :param acting: Binding.
    :param showing: Binding of the same environment; None: there are no goal pictures.
    """

    arm = None  # its joints are not told

    def __init__(self, acting: Binding, showing: Binding | None = None) -> None:
        self._acting, self._showing = acting, showing
        self._seed: int | None = None
        self._target = np.zeros(3)
        self._stamp_ns = 0
        self._goal: Observation | None = None

    @property
    def task_name(self) -> str:
        """Return the name of the task."""
        return self._acting.task_name

    @property
    def camera_matrix(self) -> np.ndarray:
        """Return the intrinsics (3, 3) in pixels."""
        return self._acting.camera.K

    @property
    def camera_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the camera's optical frame in the world."""
        return self._acting.camera.pose

    def reset(self, seed: int) -> Observation:
        """
        Begin the scene of a seed.

        :raises SceneError: for a seed that is no integer from 0 on.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise SceneError(f'seed {seed!r}: expected an integer from 0 on')
        self._acting.reset(int(seed))
        self._seed, self._goal, self._stamp_ns = int(seed), None, 0
        self._target = self._acting.gripper()[:3]
        return self.observe()

    def step(self, action: ArrayLike) -> Observation:
        """
        Act for one control period.

        :param action: (4,) displacement in m and gripper opening, limited as in contract.py.
        :raises SceneError: as check_action does; then nothing moves.
        """
        self.check_action(action)
        action = np.asarray(action, np.float64)
        move = np.clip(action[:3], np.negative(ACTION_LIMIT), ACTION_LIMIT)
        self._target = np.clip(self._target + move, WORKSPACE_LOW, WORKSPACE_HIGH)
        self._acting.move(self._target, float(np.clip(action[3], 0, 1)))
        self._stamp_ns += round(1e9 * CONTROL_PERIOD)
        return self.observe()

    def check_action(self, action: ArrayLike) -> None:
        """Raise SceneError for another shape than (4,) and for values that are not finite."""
        action = np.asarray(action, np.float64)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise SceneError(f'action {action}: expected 4 finite numbers (dx, dy, dz, opening)')

    def observe(self, hide_arm: bool = False) -> Observation:
        """Return the Observation of now; SceneError before the first reset and for hide_arm."""
        self._check(hide_arm)
        return self._observation(self._acting)

    def goal(self, hide_arm: bool = False) -> Observation:
        """
        Return the Observation of the goal.

        :raises SceneError: before the first reset, for hide_arm, and where the environment shows
            none.
        """
        seed = self._check(hide_arm)
        if self._showing is None:
            raise SceneError(f'task {self.task_name}: this environment shows no goal')
        if self._goal is None:
            self._showing.reset(seed)
            self._showing.solve()
            found = self._observation(self._showing)
            self._goal = replace(found, stamp_ns=0)
        return self._goal

    def distances(self) -> np.ndarray:
        """Return (K,) metres from each object to its goal."""
        gaps = self._acting.object_poses()[:, :3] - self._acting.goal_places()
        return np.asarray(np.linalg.norm(gaps, axis=1))

    def outcome(self) -> str:
        """Return 'success' or 'failure', by the environment's own signal."""
        return 'success' if self._acting.succeeds() else 'failure'

    def close(self) -> None:
        """Free both environments."""
        for binding in filter(None, (self._acting, self._showing)):
            binding.close()

    def _check(self, hide_arm: bool) -> int:
        """Return the seed of the scene."""
        if hide_arm:
            raise SceneError(f'task {self.task_name}: this environment cannot hide its robot')
        if self._seed is None:
            raise SceneError(f'task {self.task_name}: reset it first')
        return self._seed

    def _observation(self, binding: Binding) -> Observation:
        poses = binding.object_poses()
        image, mask = binding.draw()
        return Observation(
            image=image, stamp_ns=self._stamp_ns, gripper=binding.gripper().astype(np.float32),
            object_names=binding.object_names,
            object_pixels=binding.camera.project(poses[:, :3]).astype(np.float32),
            object_poses=poses, robot_mask=mask, arm_joints=np.empty(0))


def metaworld(task: str = 'push-v3', image_size: int = 64, **options: Any) -> GymWorld:
    """
    Make a world of Meta-World, the plugin 'metaworld'.

    :param task: name of one of its environments, such as 'push-v3'.
    :param image_size: width and height of the pictures in pixels.
    :raises ConfigError: if Meta-World is not installed.
    :raises SceneError: for an unknown task.
    """
    from sim_bridge.metaworld import MetaWorld
    return GymWorld(MetaWorld(task, image_size, **options), MetaWorld(task, image_size, **options))
