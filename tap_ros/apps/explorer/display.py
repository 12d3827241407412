# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What browsers are shown, and goals made by hand of it where no simulator takes goal pictures."""

from collections.abc import Mapping
from functools import cache
from itertools import compress
import json
import math
import threading
import time
from types import MappingProxyType
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import SelectObjects
from tap_ros.apps.explorer.events import Events
from tap_ros.base.contract import SEEN
from tap_ros.base.errors import TapError
from tap_ros.base.plugins import load_plugin
from tap_ros.base.text import escaped, listing
from tap_ros.images.drawing import overlay
from tap_ros.messages.images import decode_image
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.ros.calls import CallError
from tap_ros.ros.topics import encode_image, encode_objects, LATCHED
from visualization_msgs.msg import ImageMarker

SILENT_S = 2.0  # after which the page says that a topic is silent
NEAR = 0.06  # of the picture's width: so near are two pixels of one object
NOTHING_SELECTED = json.dumps(
    {'kind': 'selection', 'count': 0, 'followed': True, 'objects': []})

Place = tuple[float, float]  # u, v in pixels


class Display:
    """
    What has come and happened, for browsers; from any thread.

    :param node: whose log names messages that cannot be used.
    :ivar lock: of all that changes; newest: {kind: newest message, when it was received}.
    :ivar sizes: {kind: (width, height)} of pictures before they are made smaller.
    :ivar outlines: the newest of each object that is followed, by its name.
    :ivar selection: what select_objects answered last, as JSON for the page.
    :ivar events: what happened.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.lock = threading.RLock()
        self.newest: dict[str, tuple[Any, float]] = {}
        self.sizes: dict[str, tuple[int, int]] = {}
        self.outlines: dict[str, ImageMarker] = {}
        self.selection, self._selections = NOTHING_SELECTED, 0
        self.events = Events(self.picture)

    def picture(self, kind: str) -> np.ndarray | None:
        """Return the newest picture of a kind, uint8 (H, W, 3); None where there is none."""
        message, _ = self.newest.get(kind, (None, 0.0))
        try:
            return None if message is None else picture_of(message, kind)
        except TapError as error:
            self.warn(error)
            return None

    def select(self, response: SelectObjects.Response, followed: bool) -> None:
        """Show outlines of objects that are followed from now on, or that are proposed."""
        self._selections += 1
        if followed:
            self.outlines.clear()  # of others, which may have had the same names
        self.selection = json.dumps({
            'kind': 'selection', 'count': self._selections, 'followed': followed,
            'objects': [{'name': escaped(one.name, 100), 'u': one.u, 'v': one.v,
                         'outline': points_of(outline)}
                        for one, outline in zip(response.objects, response.outlines)]})

    def places(self, kind: str) -> dict[str, Place]:
        """Return the places of objects by name; empty where they cannot be used."""
        message, _ = self.newest.get(kind, (ObjectStates(), 0.0))
        try:
            found, pixels = decode_objects(message, kind)
            return {each: (u, v) for each, (u, v) in zip(found, pixels.tolist())}
        except TapError as error:
            self.warn(error)
            return {}

    def subgoal(self) -> str:
        """Say what the newest subgoal tells, '' without one that can be used."""
        message, _ = self.newest.get('subgoal', (None, 0.0))
        if message is None:
            return ''
        try:
            undecided = decode_subgoal(message, message.object_names).undecided
        except TapError:
            return ''
        names = listing(compress(message.object_names, undecided))
        return f'undecided about {names}' if names else 'the subgoal is there'

    def expected(self) -> dict[str, Place]:
        """Return where the newest subgoal expects objects; empty if not in the camera's pixels."""
        message, _ = self.newest.get('subgoal', (Subgoal(), 0.0))
        if (message.image.width, message.image.height) != self.sizes.get('camera'):
            return {}  # of a part of the picture
        return {name: (at.x, at.y) for name, at in zip(
            message.object_names, message.expected_pixels) if math.isfinite(at.x + at.y)}

    def size(self, kind: str) -> dict[str, int]:
        """Return width and height of the newest picture of a kind; 0 without one."""
        return dict(zip(('width', 'height'), self.sizes.get(kind, (0, 0))))

    def warn(self, error: TapError) -> None:
        """Log what cannot be shown, now and then."""
        self._node.get_logger().warning(escaped(error, 300), throttle_duration_sec=10.0)


def picture_of(message: Any, kind: str) -> np.ndarray:
    """Return what is shown of a message: uint8 (H, W, 3); of a Subgoal with its maps."""
    if not isinstance(message, Subgoal):
        return decode_image(message, kind)
    one = decode_subgoal(message, message.object_names)
    return overlay(one.image, one.object_maps)


def listed(places: Mapping[str, Place], message: ObjectStates | None = None,
           outlines: Mapping[str, ImageMarker] = MappingProxyType({})) -> list[dict[str, Any]]:
    """
    Return places as the page takes them.

    :param message: that they are of; it may say how sure they are.
    :param outlines: the newest ones by name; those of its picture are taken.
    """
    known = {one.name: {'state': state, 'confidence': round(confidence, 2)}
             for one, state, confidence in zip(
                 message.objects, message.states, message.confidence)} if message else {}
    shapes = {name: {'outline': points_of(one)} for name, one in outlines.items()
              if message and one.header.stamp == message.header.stamp}
    return [{'name': name, 'u': round(u, 2), 'v': round(v, 2), **known.get(name, {}),
             **shapes.get(name, {})} for name, (u, v) in places.items()]


def points_of(outline: Any) -> list[list[float]]:
    """Return the points of a message, (u, v) in pixels of the camera."""
    return [[round(point.x, 1), round(point.y, 1)] for point in outline.points]


def silence(now: float, newest: tuple[Any, float] | None) -> str:
    """Return since when a topic is silent, in steps that do not change with every look."""
    if newest is None:
        return 'has sent nothing yet'
    age = now - newest[1]
    return f'has been silent for {age:.0f} s' if age > SILENT_S else ''


@cache
def grips(task: str) -> bool:
    """Return whether a task needs a gripper, which nothing plans; False for an unknown one."""
    try:
        return bool(getattr(load_plugin('tap_ros.tasks', task), 'gripping', False))
    except TapError:
        return False


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
        if camera is None or time.monotonic() - camera[1] > SILENT_S:
            raise CallError('the camera is silent; no picture to take')
        message, _ = camera
        if isinstance(message, CompressedImage):
            header = message.header
            message = encode_image(decode_image(message, 'camera'), header.stamp, header.frame_id)
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
        message = encode_objects(goals, np.column_stack([u, v]), None, of.header.stamp,
                                 of.header.frame_id, ObjectStates.SOURCE_TRACKED)
        message.states, message.confidence = states, confidence
        self._publish(message, 'goal/objects')

    def _publish(self, message: Any, topic: str) -> None:
        kind = type(message)
        if kind not in self._made:
            self._made[kind] = self._node.create_publisher(kind, topic, LATCHED)
        self._made[kind].publish(message)


def simulated(goals: Mapping[str, Place], truth: Mapping[str, Place],
              width: int) -> dict[str, str]:
    """
    Return what the simulator calls objects, by their names here; not what it has nowhere near.

    :param goals: of the objects; those that are followed have names of their own, and the pixels
        of their middles.
    :param truth: goals that the simulator tells for measuring, where objects are followed.
    :param width: of the goal picture.
    """
    nearest = {name: min(truth, key=lambda each: math.dist(truth[each], goal))
               for name, goal in goals.items()}
    return {name: their for name, their in nearest.items()
            if math.dist(truth[their], goals[name]) < NEAR * width}


def _by_name(message: ObjectStates | None) -> dict[str, tuple[float, float, str, float]]:
    """Return pixel (u, v), state and confidence by name."""
    if message is None:
        return {}
    return {one.name: (one.u, one.v, state, confidence) for one, state, confidence in zip(
        message.objects, message.states or [SEEN] * len(message.objects),
        message.confidence or [1.0] * len(message.objects))}
