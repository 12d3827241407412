# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes transforms as tf does, where its message is installed."""

from collections.abc import Iterable
import contextlib

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sim_bridge.world.transforms import Transform
from tap_ros.nodes.topics import LATCHED


class TransformPublisher:
    """
    Publishes /tf and /tf_static; nothing where tf2_msgs is not installed.

    :param node: rclpy Node.
    """

    def __init__(self, node: Node) -> None:
        self._moving = self._fixed = None
        with contextlib.suppress(ImportError):  # no wheel has it
            from tf2_msgs.msg import TFMessage
            self._message = TFMessage
            # Qualities as of tf2_ros' broadcasters.
            self._moving = node.create_publisher(TFMessage, '/tf', QoSProfile(depth=100))
            self._fixed = node.create_publisher(TFMessage, '/tf_static', LATCHED)

    def moving(self, transforms: Iterable[Transform], stamp: Time) -> None:
        """Publish transforms of this time, once: of a second time listeners would complain."""
        if self._moving is not None:
            self._moving.publish(self._message(transforms=_encode(transforms, stamp)))

    def fixed(self, transforms: Iterable[Transform], stamp: Time) -> None:
        """Publish all transforms that hold from now on, also for who comes later."""
        if self._fixed is not None:
            self._fixed.publish(self._message(transforms=_encode(transforms, stamp)))


def _encode(transforms: Iterable[Transform], stamp: Time) -> list[TransformStamped]:
    messages = []
    for transform in transforms:
        message = TransformStamped(child_frame_id=transform.child)
        message.header.stamp, message.header.frame_id = stamp, transform.parent
        x, y, z = transform.pose[:3, 3].tolist()
        message.transform.translation = Vector3(x=x, y=y, z=z)
        x, y, z, w = transform.quaternion.tolist()
        message.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
        messages.append(message)
    return messages
