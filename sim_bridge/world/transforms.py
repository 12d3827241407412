# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the frames of the cameras and of the arm are, as tf tells it."""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from tap_ros.contract import WORLD_FRAME
from tap_ros.robots.arm import Arm, BASE_FRAME, TIP_FRAME, turned


@dataclass(frozen=True)
class Transform:
    """The pose of one frame in another, its parent."""

    parent: str
    child: str
    pose: np.ndarray  # (4, 4), rotation and metres

    @property
    def quaternion(self) -> np.ndarray:
        """Return the rotation (4,) as x, y, z, w, as ROS has it."""
        wxyz = np.empty(4)
        mujoco.mju_mat2Quat(wxyz, self.pose[:3, :3].ravel())
        return np.roll(wxyz, -1)


def fixed_arm_transforms(arm: Arm) -> list[Transform]:
    """Return where the arm's base and the fingertips are, which no joint changes."""
    (x, y, z), roll = arm.origins[-1]
    return [Transform(WORLD_FRAME, BASE_FRAME, arm.mount.pose),
            Transform(arm.links[-1], TIP_FRAME, turned((x, y, z + arm.mount.tool), roll, 0.0))]


def arm_transforms(arm: Arm, joints: ArrayLike) -> Iterator[Transform]:
    """
    Yield where each link is in the one before.

    :param joints: (J,) rad.
    :return: J, from the base on.
    """
    for parent, child, origin, angle in zip(
            arm.links, arm.links[1:], arm.origins, np.asarray(joints, np.float64)):
        yield Transform(parent, child, turned(*origin, angle))
