# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures without the robot, from camera pictures and robot masks of the same stamp."""

from collections.abc import Sequence
import threading
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_ros.images.robot_mask import FreeView, RobotMask
from tap_ros.messages.images import decode_image, decode_mask
from tap_ros.messages.stamps import to_nanoseconds


def warn_if_unlike(node: Node, robot_mask: str, trained: Sequence[str], what: str) -> None:
    """
    Warn if networks see other pictures than in their training.

    :param robot_mask: parameter of the node; trained: those that pictures were as with then.
    :param what: the networks, for the message.
    """
    if robot_mask not in trained:
        node.get_logger().warning(
            f'parameter robot_mask is {robot_mask}, but the {what} was trained on pictures as '
            f'with {" or ".join(trained)}; what it predicts may be worse')


class RobotView:
    """
    Fills what the robot hides with what was seen there last; thread-safe.

    :ivar robot_mask: as the parameter; used: whether anything is filled.
    """

    def __init__(self, robot_mask: RobotMask) -> None:
        self.robot_mask, self.used = robot_mask, robot_mask != 'none'
        self._view = FreeView(robot_mask)
        self._lock = threading.Lock()
        self.clear()

    def clear(self) -> None:
        """Forget what was seen: another scene begins."""
        with self._lock:
            self._view.clear()
            self._newest = -1, -1  # jumps of the clock, and stamp in ns of the newest picture

    def see(self, image: Any, mask: Image, jumps: int) -> np.ndarray:
        """
        Fill a picture of the camera, and remember what it shows if it is the newest.

        :param image: sensor_msgs/Image or CompressedImage.
        :param mask: its robot mask, of the same stamp.
        :param jumps: how often the clock of the stamps has jumped; another number is another
            scene.
        :return: uint8 (H, W, 3).
        :raises ImageError: for a picture or mask that cannot be used.
        """
        picture = decode_image(image, 'camera/image_raw')
        values = decode_mask(mask, 'camera/robot_mask', picture.shape[:2])
        moment = jumps, to_nanoseconds(image.header.stamp)
        with self._lock:
            if jumps != self._newest[0]:
                self._view.clear()
                self._newest = -1, -1
            if moment <= self._newest:
                return self._view.fill(picture, values)
            self._newest = moment
            return self._view.update(picture, values)

    def fill_goal(self, picture: np.ndarray, mask: Image) -> np.ndarray:
        """
        Fill a goal picture, uint8 (H, W, 3), with what the camera has seen.

        :param mask: its robot mask, of the same stamp.
        :raises ImageError: for a mask that cannot be used.
        """
        values = decode_mask(mask, 'goal/robot_mask', picture.shape[:2])
        with self._lock:
            return self._view.fill(picture, values)
