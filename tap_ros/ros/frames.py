# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where frames are that do not move, as tf_static tells: of a camera, of a robot's base."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped
from tap_ros.ros.parameters import pose_matrix

MOST_FRAMES = 1000  # of more, those that come later are not known


class FixedFrames:
    """
    Listens to tf_static, in the namespace of the node; what is on tf moves, and is not known.

    Without the package tf2_msgs, of which there are no wheels, nothing is known.

    :param node: rclpy Node.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._parents: dict[str, tuple[str, np.ndarray]] = {}  # by the child: (parent, pose in it)
        if find_spec('tf2_msgs') is not None:
            node.create_subscription(
                import_module('tf2_msgs.msg').TFMessage, 'tf_static', self._take,
                QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def pose(self, frame: str, root: str) -> np.ndarray | None:
        """Return the pose (4, 4) of a frame in another one; None if they are not connected."""
        up, down = self._ancestors(frame), self._ancestors(root)
        common = next((name for name in up if name in down), None)
        return None if common is None else np.linalg.inv(down[common]) @ up[common]

    def _ancestors(self, frame: str) -> dict[str, np.ndarray]:
        """Return the pose of a frame in itself, in its parent, and so on."""
        name, found = frame.lstrip('/'), dict[str, np.ndarray]()
        pose = np.eye(4)
        while name not in found:  # else they go round in circles
            found[name] = pose
            if name not in self._parents:
                break
            name, own = self._parents[name]
            pose = own @ pose
        return found

    def _take(self, message: Any) -> None:
        for one in message.transforms:
            parent, child = one.header.frame_id.lstrip('/'), one.child_frame_id.lstrip('/')
            place, turn = one.transform.translation, one.transform.rotation
            try:
                pose = pose_matrix([getattr(place, axis) for axis in 'xyz'],
                                   [getattr(turn, axis) for axis in 'xyzw'])
            except ConfigError as error:
                self._node.get_logger().warning(
                    f'tf_static: {escaped(child)} in {escaped(parent)} is ignored: {error}',
                    throttle_duration_sec=5.0)
                continue
            if child in self._parents or len(self._parents) < MOST_FRAMES:
                self._parents[child] = parent, pose
