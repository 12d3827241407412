# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a Client sees: the newest pictures of the camera and of the goal, and their objects."""

from dataclasses import dataclass
import threading

import numpy as np
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_ros.messages.images import decode_image
from tap_ros.messages.objects import decode_objects
from tap_ros.ros.calls import CallError
from tap_ros.ros.observations import Observations
from tap_ros.ros.topics import LATCHED, STREAM

TOPICS = {'camera': {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects')},
          'goal': {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}}


@dataclass(frozen=True)
class View:
    """
    A picture and the objects in it.

    :param image: (H, W, 3) uint8.
    :param names: of K objects.
    :param pixels: (K, 2) float32, (u, v) of each.
    :param positions: (K, 3) m; NaN where nobody knows them.
    :param stamp_ns: of the picture.
    """

    image: np.ndarray
    names: tuple[str, ...]
    pixels: np.ndarray
    positions: np.ndarray
    stamp_ns: int


class Views:
    """
    The newest views of 'camera' and 'goal', subscribed to when they are first asked for.

    :param node: rclpy Node that another thread spins.
    """

    def __init__(self, node: Node, group: CallbackGroup) -> None:
        self._node, self._group, self._lock = node, group, threading.Lock()
        self._views: dict[str, Observations] = {}

    def subscribe(self, name: str) -> Observations:
        """Return the Observations of one of them."""
        with self._lock:
            if name not in self._views:
                views = self._views[name] = Observations(*TOPICS[name], latched=name == 'goal')
                views.subscribe(self._node, TOPICS[name], LATCHED if name == 'goal' else STREAM,
                                self._group)
            return self._views[name]

    def wait(self, name: str, after_ns: int, objects: bool, timeout_s: float) -> View:
        """
        Return the newest view.

        :param after_ns: wait for one that is stamped later than this.
        :param objects: wait for one with the objects in it.
        :raises CallError: naming the silent topic.
        """
        views, topics = self.subscribe(name), TOPICS[name]
        found = views.wait(('image', 'objects') if objects else ('image',), timeout_s, after_ns)
        if found is None:
            silent = 'objects' if views.newest('image', after_ns=after_ns) else 'image'
            raise CallError(f'{views.names([silent], explained=True)}: '
                            f'nothing new came within {timeout_s:g} s')
        listed = found.messages.get('objects', ObjectStates())
        return View(decode_image(found.messages['image'], topics['image'][1]),
                    *decode_objects(listed, topics['objects'][1]), positions_of(listed),
                    found.stamp_ns)


def positions_of(message: ObjectStates) -> np.ndarray:
    """Return (K, 3) metres."""
    points = [state.pose.position for state in message.objects]
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)
