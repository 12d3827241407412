# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a Client sees: the newest pictures of the camera and of the goal, and their objects."""

from dataclasses import dataclass

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


def observe(node: Node, name: str, group: CallbackGroup) -> Observations:
    """Return what comes from now on of 'camera' or 'goal', while another thread spins the node."""
    latched = name == 'goal'
    views = Observations(*TOPICS[name], latched=latched)
    views.subscribe(node, TOPICS[name], LATCHED if latched else STREAM, group)
    return views


def wait_for_view(views: Observations, name: str, after_ns: int, objects: bool,
                  timeout_s: float) -> View:
    """
    Return the newest view.

    :param views: as observe returns for this name.
    :param after_ns: wait for one that is stamped later than this.
    :param objects: wait for one with the objects in it.
    :raises CallError: naming the silent topic.
    """
    found = views.wait(('image', 'objects') if objects else ('image',), timeout_s, after_ns)
    if found is None:
        silent = 'objects' if views.newest('image', after_ns=after_ns) else 'image'
        raise CallError(f'{views.names([silent], explained=True)}: '
                        f'nothing new came within {timeout_s:g} s')
    listed, topics = found.messages.get('objects', ObjectStates()), TOPICS[name]
    return View(decode_image(found.messages['image'], topics['image'][1]),
                *decode_objects(listed, topics['objects'][1]), positions_of(listed),
                found.stamp_ns)


def positions_of(message: ObjectStates) -> np.ndarray:
    """Return (K, 3) metres."""
    points = [state.pose.position for state in message.objects]
    return np.array([(p.x, p.y, p.z) for p in points]).reshape(-1, 3)
