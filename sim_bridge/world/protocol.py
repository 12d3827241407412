# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What sim_node, collecting and an evaluation need of a simulator: the World protocol."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import ACTION_LIMIT, CAMERA_SIZE
from tap_ros.base.errors import SceneError
from tap_ros.base.plugins import load_plugin
from tap_ros.robots.arm import Arm


@dataclass(frozen=True)
class Observation:
    """What the camera and the sensors say at one moment; object poses are ground truth."""

    image: np.ndarray  # (H, W, 3) uint8 rgb
    stamp_ns: int  # simulated time
    gripper: np.ndarray  # (4,) float32: x, y, z of the fingertips in m, opening in [0, 1]
    object_names: tuple[str, ...]
    object_pixels: np.ndarray  # (K, 2) float32 (u, v) of the object origins
    object_poses: np.ndarray  # (K, 7) float64: x, y, z in m, quaternion x, y, z, w
    robot_mask: np.ndarray  # (H, W) uint8, values as in contract.py; zeros where it is not known
    arm_joints: np.ndarray  # (J,) float64 rad, as Arm.joints; empty where there is no arm


class World(Protocol):
    """
    A simulated world with one robot, one camera and tasks.

    What a name of the plugin group 'tap_ros.worlds' stands for is called as
    `make(task, image_size)`. A scene follows from its seed alone.

    Some worlds can do more; who needs that asks by `ability`, which raises SceneError if the
    world lacks the method. The MuJoCo table, simulator.Simulator, has all of them:
    `observer_picture()`, `move_goal(names, pixels)`, and for `collect`
    `demonstrate(seed, num_frames)`, which lets an expert act and returns a
    demonstrations.Demonstration. Keyword arguments look=, appearance= and arm= are the table's.

    :ivar task_name: of the present task.
    :ivar arm: the Arm that is seen, None where it is not known.
    :ivar camera_matrix: (3, 3) intrinsics in pixels; (0, 0) is the centre of the top-left pixel.
    :ivar camera_pose: (4, 4) of the camera's optical frame in the world; None: not known.
    """

    @property
    def task_name(self) -> str: ...

    @property
    def arm(self) -> Arm | None: ...

    @property
    def camera_matrix(self) -> np.ndarray: ...

    @property
    def camera_pose(self) -> np.ndarray | None: ...

    def reset(self, seed: int) -> Observation:
        """
        Begin the scene of a seed, with its goal.

        :param seed: integer from 0 on.
        :raises SceneError: for another seed, and where a scene cannot be made or drawn.
        """

    def step(self, action: ArrayLike) -> Observation:
        """
        Act for one control period.

        :param action: (4,) displacement x, y, z in m, limited to contract.ACTION_LIMIT and to
            what can be reached, and gripper opening from 0 (closed) to 1.
        :raises SceneError: as check_action does; then nothing moves.
        """

    def check_action(self, action: ArrayLike) -> None:
        """Raise SceneError for another shape, values not finite, or what the arm cannot do."""

    def observe(self, hide_arm: bool = False) -> Observation:
        """Return the Observation of now; SceneError if the arm cannot be left out of it."""

    def goal(self, hide_arm: bool = False) -> Observation:
        """Return the Observation of the goal; SceneError if the arm cannot be left out of it."""

    def distances(self) -> np.ndarray:
        """Return (K,) metres from each object's origin to its goal."""

    def outcome(self) -> str:
        """Return 'success' or 'failure', as the scene is now."""

    def close(self) -> None:
        """Free what the world holds; it cannot be used after that."""


def make_world(name: str, task: str, image_size: int = CAMERA_SIZE, **options: Any) -> World:
    """
    Make a world.

    :param name: of the plugin group 'tap_ros.worlds'.
    :param task: one of its tasks.
    :param image_size: width and height of its pictures in pixels.
    :param options: only for worlds that take them.
    :raises ConfigError: for an unknown name.
    :raises SceneError: for a task or option that the world does not have.
    """
    make: Callable[..., World] = load_plugin('tap_ros.worlds', name)
    try:
        return make(task, image_size, **options)
    except TypeError as error:
        if 'unexpected keyword argument' not in str(error):
            raise
        raise SceneError(f'world {name} does not take {", ".join(options)}') from error


def ability(world: World, method: str) -> Callable[..., Any]:
    """
    Return a method that only some worlds have.

    :raises SceneError: if this world lacks it.
    """
    if not hasattr(world, method):
        raise SceneError(f'the world of task {world.task_name} lacks {method}; '
                         'world mujoco_table has it')
    return getattr(world, method)


def clip_action(action: ArrayLike) -> np.ndarray:
    """
    Limit an action to what is commanded in one control period.

    :param action: (4,) displacement x, y, z in m and gripper opening in [0, 1].
    :return: (4,) float64.
    :raises SceneError: for another shape or values that are not finite.
    """
    action = np.asarray(action, np.float64)
    if action.shape != (4,) or not np.isfinite(action).all():
        raise SceneError(f'action {action}: expected 4 finite numbers (dx, dy, dz, opening)')
    return np.append(clip_moves(action[:3]), np.clip(action[3], 0, 1))


def clip_moves(moves: np.ndarray) -> np.ndarray:
    """Limit displacements (..., 3), in m, to what is commanded in one control period."""
    return np.clip(moves, np.negative(ACTION_LIMIT), ACTION_LIMIT)
