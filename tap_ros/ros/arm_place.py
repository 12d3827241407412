# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where an arm stands: as parameters say that were given, else as tf_static tells."""

import math

from rclpy.node import Node
from tap_ros.base.contract import WORLD_FRAME
from tap_ros.base.errors import KinematicsError
from tap_ros.base.text import escaped
from tap_ros.robots.arm import BASE_FRAME, Mount
from tap_ros.ros.frames import FixedFrames
from tap_ros.ros.parameters import declared_mount, MOUNT, Parameters

APART, TURNED = 0.01, math.radians(1)  # m, rad, up to which two tell the same
NEAR_MIDDLE = 0.2  # m from the table's middle, where no base stands


class ArmPlace:
    """
    The Mount of a node's arm; the length of its tool is always that of the parameter.

    :param params: Parameters of the node, with those of declare_mount.
    :param frames: what tf_static tells, where the node has it already.
    """

    def __init__(self, node: Node, params: Parameters, frames: FixedFrames | None = None) -> None:
        self._node, self._declared = node, declared_mount(params)  # read-only parameters
        self._logged = ''  # what was wrong
        self._missing = [name for name in MOUNT if name not in params.given]
        self._typed = len(self._missing) < len(MOUNT)
        self._first: Mount | None = None  # that tf_static told
        self._frames = frames or FixedFrames(node)
        self._frame = params['mount_frame'] or f'{params["joint_prefix"]}{BASE_FRAME}'

    def told(self) -> Mount | None:
        """
        Return the Mount, None where neither parameters nor tf_static tell it.

        :raises KinematicsError: where they contradict each other, or tf_static itself; where some
            parameters are missing; where the base is tilted, or in the middle of the table.
        """
        typed, pose = self._declared, self._frames.pose(self._frame, WORLD_FRAME)
        if pose is None:
            if self._typed and self._missing:
                raise KinematicsError(f'{", ".join(self._missing)}: not set, but other parameters '
                                      'of the mount are; set all four, or none')
            return typed if self._typed else None
        x, y, z = pose[:3, 3].tolist()
        found = Mount((x, y, z), math.atan2(pose[1, 0], pose[0, 0]), typed.tool)
        where = f'by tf_static {self._frame} is in {WORLD_FRAME} at {_words(found)}'
        if pose[2, 2] < math.cos(TURNED):
            tilt = math.degrees(math.acos(max(pose[2, 2], -1.0)))
            raise KinematicsError(f'{where}, and tilted by {tilt:.0f} degrees; the base has to '
                                  'stand upright there')
        if math.hypot(x, y) < NEAR_MIDDLE:
            raise KinematicsError(f'{where}, in the middle of the table; {WORLD_FRAME} is the '
                                  "table's middle here, and a robot's own frame in its driver")
        self._first = self._first or found
        if not _same(found, self._first):
            raise KinematicsError(f'{where}, and before at {_words(self._first)}; restart the '
                                  'node if the arm was moved')
        if _same(found, typed):
            return typed
        if self._typed:
            raise KinematicsError(f'{where}, but by mount_x to mount_turn at {_words(typed)}; '
                                  'correct one of both')
        return found

    def mount(self) -> Mount:
        """
        Return the Mount.

        :raises KinematicsError: as told does, which is logged; and where nothing tells it.
        """
        try:
            found = self.told()
        except KinematicsError as error:
            if self._logged != str(error):  # a tracker goes on without the gripper
                self._logged = str(error)
                self._node.get_logger().warning(escaped(error, 1000))
            raise
        if found is None:
            raise KinematicsError(
                'nothing tells where the arm stands: set mount_x, mount_y, mount_z and '
                f'mount_turn, or publish on tf_static where {self._frame} is in {WORLD_FRAME}; '
                'that needs the package tf2_msgs here, too')
        return found

    def usual(self) -> Mount:
        """Return the Mount, that of the simulated table where nothing tells it; else as told."""
        return self.told() or self._declared


def _same(one: Mount, other: Mount) -> bool:
    return math.dist(one.position, other.position) <= APART and (
        abs(math.remainder(one.yaw - other.yaw, math.tau)) <= TURNED)


def _words(mount: Mount) -> str:
    x, y, z = mount.position
    return f'({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {mount.yaw:.3f} rad'
