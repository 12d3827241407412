# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goals made by hand where no simulator takes goal pictures: photographed, and objects placed."""

from collections.abc import Mapping
import math
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_ros.nodes.calls import CallError
from tap_ros.nodes.explorer.display import Place, SILENT_S
from tap_ros.nodes.ros_messages import encode_objects
from tap_ros.nodes.topics import LATCHED
from tap_ros.text import escaped, listing
from tap_ros.tracking.protocols import SEEN

NEAR = 0.06  # of the picture's width: so near are two pixels of one object


class GoalByHand:
    """
    Publishes goal pictures and goal objects.

    :param node: rclpy Node.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._made: dict[type, Any] = {}  # publishers; a goal that is not ours has none

    def photograph(self, camera: tuple[Any, float] | None, followed: bool) -> None:
        """
        Publish a picture of the camera as the goal.

        :param camera: its newest message and when that was received, if there is one.
        :param followed: whether a node follows objects, and finds them there; else no object is
            where it was in the goal before.
        :raises CallError: where that is of no use.
        """
        message, received = camera or (None, -math.inf)
        if time.monotonic() - received > SILENT_S:
            raise CallError('photograph: the camera is silent; no picture to take')
        if not isinstance(message, Image):
            raise CallError('photograph: a goal picture is sensor_msgs/Image; start with '
                            'image_transport:=raw')
        if not followed:
            self._publish(ObjectStates(header=message.header), 'goal/objects')
        self._publish(message, 'goal/image')

    def place(self, name: str, pixel: Place, newest: Mapping[str, Any]) -> None:
        """
        Publish goal objects of which one is elsewhere.

        With a goal picture it is a pixel of that; the others are where they were found in it.
        Without one it is a pixel of the camera's picture; what has no goal is to stay where it is.

        :param newest: messages 'objects', 'goal_objects' and 'goal', where there are some.
        :raises CallError: when no object has this name.
        """
        objects, goals = (_by_name(newest.get(kind)) for kind in ('objects', 'goal_objects'))
        if name not in objects:
            raise CallError(f'{escaped(name)} is not followed; the objects are '
                            f'{listing(objects) or "none"}')
        of = newest.get('goal', newest['objects'])
        if 'goal' not in newest:
            goals = objects | goals
        elif goals and newest['goal_objects'].header.stamp != of.header.stamp:
            goals = {}  # in another goal picture
        goals = {each: goal for each, goal in goals.items() if each in objects}
        goals[name] = *pixel, SEEN, 1.0
        u, v, states, confidence = zip(*goals.values())
        self._publish(encode_objects(
            goals, np.column_stack([u, v]), None, of.header.stamp, of.header.frame_id,
            ObjectStates.SOURCE_TRACKED, states, confidence), 'goal/objects')

    def _publish(self, message: Any, topic: str) -> None:
        kind = type(message)
        if kind not in self._made:
            self._made[kind] = self._node.create_publisher(kind, topic, LATCHED)
        self._made[kind].publish(message)


def simulated(name: str, pixel: Place, goals: Mapping[str, Place],
              truth: Mapping[str, Place], width: int) -> dict[str, Place]:
    """
    Return what the simulator calls an object, and where it is to put its goal; {} if nowhere.

    :param pixel: in the goal picture.
    :param goals: of the objects; those that are followed have names of their own, and the pixels
        of their middles.
    :param truth: what the simulator says where it is asked only for measuring, else empty.
    :param width: of the goal picture.
    """
    if name not in goals or not truth:
        return {name: pixel} if name in goals else {}
    nearest = min(truth, key=lambda each: math.dist(truth[each], goals[name]))
    du, dv = np.subtract(truth[nearest], goals[name]).tolist()
    return {nearest: (pixel[0] + du, pixel[1] + dv)} if math.hypot(du, dv) < NEAR * width else {}


def _by_name(message: ObjectStates | None) -> dict[str, tuple[float, float, str, float]]:
    """Return pixel (u, v), state and confidence by name."""
    if message is None:
        return {}
    return {one.name: (one.u, one.v, state, confidence) for one, state, confidence in zip(
        message.objects, message.states or [SEEN] * len(message.objects),
        message.confidence or [1.0] * len(message.objects))}
