# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A Gymnasium environment as a World; metaworld.py is one."""

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.demonstrations import Demonstration
from sim_bridge.pushes import demonstrate_pushes, Route
from sim_bridge.world.camera import OneCamera
from sim_bridge.world.protocol import clip_action, Observation
from tap_ros.base.contract import CONTROL_PERIOD, WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.base.errors import SceneError

# m that fingertips stay behind where they shall be; it is made up for. Blocked ones are behind by
# more, which is forgotten, so that they come back when told to.
LAG = 0.02


class GymWorld(OneCamera, ABC):
    """
    What environments have in common.

    A subclass says what one means, in the frame and the units of contract.py: the abstract
    methods, and these attributes.

    :ivar task_name: what the environment is about.
    :ivar object_names: of its K objects.
    :ivar camera: that takes its pictures.
    :ivar slides: whether what `route` begins with can be pushed about.
    :ivar ways: places (x, y), m, by which that has to be pushed to its goal, for who demonstrates.
    """

    task_name: str
    object_names: tuple[str, ...]
    arm = None  # its joints are not told
    slides = True
    ways: tuple[tuple[float, float], ...] = ()
    seed: int | None = None  # of the scene
    _goal: Observation | None = None

    @abstractmethod
    def begin(self, seed: int) -> None:
        """Begin the scene of a seed; the same scene again if it is asked for again."""

    @abstractmethod
    def move(self, target: np.ndarray, opening: float) -> None:
        """Bring the fingertips to (3,) m in one control period; opening of the gripper, 0 to 1."""

    @abstractmethod
    def gripper(self) -> np.ndarray:
        """Return (4,): the fingertips' place in m and the opening from 0 to 1."""

    @abstractmethod
    def object_poses(self) -> np.ndarray:
        """Return (K, 7): place in m and quaternion x, y, z, w of each object."""

    @abstractmethod
    def goal_places(self) -> np.ndarray:
        """Return (K, 3) m, where each object shall be."""

    @abstractmethod
    def succeeds(self) -> bool:
        """Return the environment's own signal of success."""

    @abstractmethod
    def draw(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture (H, W, 3) uint8, and its robot mask (H, W) as in contract.py."""

    @abstractmethod
    def solve(self) -> None:
        """Bring the scene to its goal, for a picture of it; SceneError where that fails."""

    @abstractmethod
    def close(self) -> None:
        """Free what the environment holds."""

    def reset(self, seed: int) -> Observation:
        """
        Begin the scene of a seed, after its goal was brought about and seen.

        :raises SceneError: for a seed that is no integer from 0 on, and as solve does.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise SceneError(f'seed {seed!r}: expected an integer from 0 on')
        self.seed, self._stamp_ns = int(seed), 0
        self.begin(self.seed)
        self.solve()
        self._goal = self.observe()
        self.begin(self.seed)
        self._target = self.gripper()[:3]
        return self.observe()

    def route(self) -> Route:
        """
        Return which object goes where, one after the other.

        The first one, by the ways, to its goal; a world that pushes several overrides it.
        """
        return [*((0, np.array(way)) for way in self.ways), (0, self.goal_places()[0, :2])]

    def step(self, action: ArrayLike) -> Observation:
        """
        Act for one control period.

        :param action: (4,) displacement in m and gripper opening, limited as in contract.py.
        :raises SceneError: as check_action does; then nothing moves.
        """
        action, hand = clip_action(action), self.gripper()[:3]
        behind = np.clip(self._target - hand, -LAG, LAG)
        self._target = np.clip(hand + behind + action[:3], WORKSPACE_LOW, WORKSPACE_HIGH)
        self.move(self._target, float(action[3]))
        self._stamp_ns += round(1e9 * CONTROL_PERIOD)
        return self.observe()

    def check_action(self, action: ArrayLike) -> None:
        """Raise SceneError for another shape than (4,) and for values that are not finite."""
        clip_action(action)

    def observe(self, hide_arm: bool = False) -> Observation:
        """Return the Observation of now; SceneError before the first reset and for hide_arm."""
        self._check(hide_arm)
        poses = self.object_poses()
        image, mask = self.draw()
        return Observation(
            image=image, stamp_ns=self._stamp_ns, gripper=self.gripper().astype(np.float32),
            object_names=self.object_names,
            object_pixels=self.camera.project(poses[:, :3]).astype(np.float32),
            object_poses=poses, robot_mask=mask, arm_joints=np.empty(0))

    def goal(self, hide_arm: bool = False) -> Observation:
        """Return the Observation of the goal; SceneError as observe does."""
        self._check(hide_arm)
        assert self._goal is not None
        return replace(self._goal, stamp_ns=0)

    def demonstrate(self, seed: int, num_frames: int = 0, pushes: str = 'goal') -> Demonstration:
        """Push the objects of `route`, to the 'goal' or at 'random', as pushes.py says."""
        return demonstrate_pushes(self, pushes, seed)

    def distances(self) -> np.ndarray:
        """Return (K,) metres from each object to its goal."""
        gaps = self.object_poses()[:, :3] - self.goal_places()
        return np.asarray(np.linalg.norm(gaps, axis=1))

    def outcome(self) -> str:
        """Return 'success' or 'failure', by the environment's own signal."""
        return 'success' if self.succeeds() else 'failure'

    def _check(self, hide_arm: bool) -> None:
        """Raise SceneError for what cannot be seen."""
        if hide_arm:
            raise SceneError(f'task {self.task_name}: this environment cannot hide its robot')
        if self.seed is None:
            raise SceneError(f'task {self.task_name}: reset it first')
