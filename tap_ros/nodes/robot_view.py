# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures without the robot, from camera pictures and robot masks of the same stamp."""

import threading
from typing import TYPE_CHECKING

from sensor_msgs.msg import Image
from tap_ros.contract import ROBOT_MASKS
from tap_ros.messages.images import decode_image, decode_mask
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.training.robot_mask import FreeView

if TYPE_CHECKING:
    from tap_ros.nodes.parameters import Parameters
    from tap_ros.training.robot_mask import RobotMask



def declare_robot_mask(parameters: 'Parameters') -> None:
    """Declare the parameter robot_mask of a node."""
    parameters.declare(
        'robot_mask', 'none',
        'What camera/robot_mask takes out of the pictures: nothing (none), the arm with its '
        'shadow (arm), or the whole robot (all). What was seen there free last takes its place.',
        choices=ROBOT_MASKS)


class RobotView:
    """
    Fills what the robot hides with what was seen there last; thread-safe.

    :param robot_mask: as the parameter.
    :ivar used: whether anything is filled.
    """

    def __init__(self, robot_mask: 'RobotMask') -> None:
        self.used = robot_mask != 'none'
        self._view = FreeView(robot_mask)
        self._lock = threading.Lock()
        self.clear()

    def clear(self) -> None:
        """Forget what was seen: another scene begins."""
        with self._lock:
            self._view.clear()
            self._newest = -1, -1  # jumps of the clock, and stamp in ns of the newest picture

    def see(self, image: Image, mask: Image, jumps: int) -> Image:
        """
        Fill a picture of the camera, and remember what it shows if it is the newest.

        :param image: sensor_msgs/Image.
        :param mask: its robot mask, of the same stamp.
        :param jumps: how often the clock of the stamps has jumped; another number is another
            scene.
        :return: sensor_msgs/Image with the header of the picture.
        :raises ImageError: for a picture or mask that cannot be used.
        """
        picture = decode_image(image, 'camera/image_raw')
        values = decode_mask(mask, 'camera/robot_mask', picture.shape[:2])
        moment = jumps, to_nanoseconds(image.header.stamp)
        with self._lock:
            if jumps != self._newest[0]:
                self._view.clear()
                self._newest = -1, -1
            if moment > self._newest:
                self._newest = moment
                filled = self._view.update(picture, values)
            else:
                filled = self._view.fill(picture, values)
        return encode_image(filled, image.header.stamp, image.header.frame_id)

    def fill_goal(self, image: Image, mask: Image) -> Image:
        """
        Fill a goal picture with what the camera has seen.

        :param image: sensor_msgs/Image; mask: its robot mask, of the same stamp.
        :return: sensor_msgs/Image with the header of the picture.
        :raises ImageError: for a picture or mask that cannot be used.
        """
        picture = decode_image(image, 'goal/image')
        values = decode_mask(mask, 'goal/robot_mask', picture.shape[:2])
        with self._lock:
            filled = self._view.fill(picture, values)
        return encode_image(filled, image.header.stamp, image.header.frame_id)
