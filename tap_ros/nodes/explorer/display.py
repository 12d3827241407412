# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What browsers are shown: pictures, places of objects, distances over time, states of nodes."""

from collections import deque
from collections.abc import Mapping
from functools import cache
import math
import time
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.errors import TapError
from tap_ros.images.drawing import overlay, png_bytes
from tap_ros.messages.images import decode_image
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.nodes.client import positions_of
from tap_ros.plugins import load_plugin
from tap_ros.text import escaped

SILENT_S = 2.0  # after which the page says that a topic is silent
FORGOTTEN_S = 60.0  # after which a node that is silent is shown no more
STALE = 3  # of diagnostic_msgs/DiagnosticStatus
MAX_STATES = 200
LARGEST = 640  # px; larger pictures are made smaller for the page
LOSSLESS = 256  # px; larger ones are sent as JPEG
POINTS = 1000  # of distances: of so many pictures, four minutes in real time

Place = tuple[float, ...]  # x, y, z in m, u, v in pixels


class Distances:
    """Distances from objects to their goals over time; a new goal or scene begins anew."""

    def __init__(self) -> None:
        self._of: tuple[tuple[str, ...], str] = (), ''  # names, unit
        self._points: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=POINTS)

    def clear(self) -> None:
        """Forget what was."""
        self._points.clear()

    def add(self, time: float, objects: Mapping[str, Place], goals: Mapping[str, Place]) -> None:
        """
        Note where objects are; in centimetres where all their poses are known, else in pixels.

        :param time: s; one that is before the newest begins anew.
        :param objects: places by name; NaN where unknown.
        :param goals: likewise; objects without one are left out.
        """
        names = tuple(name for name in objects if name in goals)
        metres = all(math.isfinite(x) for name in names for side in (objects, goals)
                     for x in side[name][:3])
        unit, part, factor = ('cm', slice(3), 100.0) if metres else ('px', slice(3, 5), 1.0)
        if (names, unit) != self._of or (self._points and time < self._points[-1][0]):
            self.clear()
        self._of = names, unit
        values = tuple(factor * math.dist(objects[name][part], goals[name][part])
                       for name in names)
        if not names or not all(map(math.isfinite, values)):
            return
        if self._points and self._points[-1][0] == time:
            self._points.pop()
        self._points.append((time, values))

    def shown(self) -> dict[str, Any]:
        """Return unit, names, times (s) and values (a list for each name)."""
        names, unit = self._of
        return {'unit': unit if self._points else '', 'names': list(names),
                'times': [round(time, 2) for time, _ in self._points],
                'values': [[round(values[k], 2) for _, values in self._points]
                           for k in range(len(names))]}


class NodeStates:
    """What the nodes say of themselves on /diagnostics."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[int, str, float]] = {}  # name -> level, text, when it came

    def add(self, message: DiagnosticArray) -> None:
        """Take what nodes say."""
        now = time.monotonic()
        self._of = {name: said for name, said in self._of.items() if now - said[-1] < FORGOTTEN_S}
        for status in message.status:
            name = escaped(status.name, 100)
            if name in self._of or len(self._of) < MAX_STATES:
                self._of[name] = status.level[0], escaped(status.message, 200), now

    def shown(self, now: float) -> list[dict[str, Any]]:
        """Return name, level and message of each, those that say nothing any more as silent."""
        return [{'name': name, 'level': STALE if now - came > SILENT_S + 1 else level,
                 'message': 'silent' if now - came > SILENT_S + 1 else text}
                for name, (level, text, came) in sorted(self._of.items())]


def picture_of(message: Any, kind: str) -> np.ndarray:
    """Return what is shown of a message: uint8 (H, W, 3); of a Subgoal with its maps."""
    if not isinstance(message, Subgoal):
        return decode_image(message, kind)
    one = decode_subgoal(
        message, message.object_names, (message.image.height, message.image.width))
    return overlay(one.image, one.object_maps)


def picture_bytes(image: np.ndarray, lossless: bool) -> bytes:
    """Encode a picture, a large one made smaller; PNG where it is small or `lossless`."""
    height, width = image.shape[:2]
    share = LARGEST / max(width, height)
    if share < 1:
        size = [max(1, round(share * side)) for side in (width, height)]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if lossless or max(width, height) <= LOSSLESS:
        return png_bytes(image)
    return cv2.imencode('.jpg', image[..., ::-1])[1].tobytes()


def places_of(message: ObjectStates, name: str) -> dict[str, Place]:
    """
    Return the places of objects by name.

    :param name: how an error calls the message.
    :raises PlanningError: as decode_objects.
    """
    found, pixels = decode_objects(message, name)
    return {each: (*position, *pixel) for each, position, pixel in zip(
        found, positions_of(message).tolist(), pixels.tolist())}


def listed(places: Mapping[str, Place], newest: tuple[ObjectStates, float] | None = None
           ) -> list[dict[str, Any]]:
    """Return places as the page takes them; with what their message says of how sure they are."""
    known: dict[str, dict[str, Any]] = {}
    if newest is not None:
        message, _ = newest
        for one, state, confidence in zip(message.objects, message.states, message.confidence):
            known[one.name] = {'state': state, 'confidence': round(confidence, 2)}
    return [{'name': name, 'u': round(u, 2), 'v': round(v, 2), **known.get(name, {})}
            for name, (*_, u, v) in places.items()]


def silence(now: float, newest: tuple[Any, float] | None) -> str:
    """Say since when a topic is silent, in steps that do not change with every look."""
    if newest is None:
        return 'nothing has come yet'
    age = now - newest[1]
    return f'silent for {age:.0f} s' if age > SILENT_S else ''


@cache
def grips(task: str) -> bool:
    """Tell whether a task needs a gripper, which nothing plans; False for an unknown one."""
    try:
        return bool(getattr(load_plugin('tap_ros.tasks', task), 'gripping', False))
    except TapError:
        return False
