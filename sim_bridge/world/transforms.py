# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the frames of the cameras and of the arm are, as tf tells it."""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from sim_bridge.world.robot_description import BASE_FRAME, joint_origins, LINKS, TIP_FRAME
from tap_ros.contract import WORLD_FRAME
from tap_ros.robots import ur10e


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


def fixed_arm_transforms(mount: ur10e.Mount = ur10e.SIMULATED) -> list[Transform]:
    """Return where the arm's base and the fingertips are, which no joint changes."""
    tip, roll = joint_origins(mount)[-1]
    return [Transform(WORLD_FRAME, BASE_FRAME, mount.pose),
            Transform(LINKS[-1], TIP_FRAME, _pose(tip, roll, 0.0))]


def arm_transforms(joints: ArrayLike) -> Iterator[Transform]:
    """
    Yield where each link is in the one before.

    :param joints: (6,) rad, of ur10e.JOINTS.
    :return: six, from the base on.
    """
    for parent, child, (place, roll), angle in zip(
            LINKS, LINKS[1:], joint_origins(), np.asarray(joints, np.float64)):
        yield Transform(parent, child, _pose(place, roll, angle))


def _pose(place: tuple[float, float, float], roll: float, yaw: float) -> np.ndarray:
    """Return the pose (4, 4) of a frame at a place (m) that is rolled, then turned (rad)."""
    c, s, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]]) @ np.array(
        [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pose[:3, 3] = place
    return pose
