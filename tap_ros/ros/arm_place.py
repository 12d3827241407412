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


class ArmPlace:
    """
    The Mount of a node's arm; the length of its tool is always that of the parameter.

    :param params: Parameters of the node, with those of declare_mount.
    :param frames: what tf_static tells, where the node has it already.
    """

    def __init__(self, node: Node, params: Parameters, frames: FixedFrames | None = None) -> None:
        self._node, self._params = node, params
        self._logged = ''  # what was wrong
        self._typed = not params.given.isdisjoint(MOUNT)
        self._frames = frames or FixedFrames(node)
        self._frame = params['mount_frame'] or f'{params["joint_prefix"]}{BASE_FRAME}'

    def told(self) -> Mount | None:
        """
        Return the Mount, None where neither parameters nor tf_static tell it.

        :raises KinematicsError: where they contradict each other, or the base does not stand
            upright.
        """
        typed, pose = declared_mount(self._params), self._frames.pose(self._frame, WORLD_FRAME)
        if pose is None:
            return typed if self._typed else None
        x, y, z = pose[:3, 3].tolist()
        found = Mount((x, y, z), math.atan2(pose[1, 0], pose[0, 0]), typed.tool)
        where = f'by tf_static {self._frame} is in {WORLD_FRAME} at {_words(found)}'
        if pose[2, 2] < math.cos(TURNED):
            tilt = math.degrees(math.acos(max(pose[2, 2], -1.0)))
            raise KinematicsError(f'{where}, and tilted by {tilt:.0f} degrees; the base has to '
                                  'stand upright there')
        if math.dist(found.position, typed.position) <= APART and (
                abs(math.remainder(found.yaw - typed.yaw, math.tau)) <= TURNED):
            return typed
        if self._typed:
            raise KinematicsError(f'{where}, but by mount_x to mount_turn at {_words(typed)}; '
                                  'leave these parameters out, or correct one of both')
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
        return self.told() or declared_mount(self._params)


def _words(mount: Mount) -> str:
    x, y, z = mount.position
    return f'({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {mount.yaw:.3f} rad'
