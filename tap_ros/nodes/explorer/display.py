# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What browsers are shown: pictures, and places of objects."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import cv2
import numpy as np
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.errors import TapError
from tap_ros.images.drawing import overlay, png_bytes
from tap_ros.messages.images import decode_image
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.plugins import load_plugin

SILENT_S = 2.0  # after which the page says that a topic is silent
LARGEST = 640  # px; larger pictures are made smaller for the page
LOSSLESS = 256  # px; larger ones are sent as JPEG

Place = tuple[float, float]  # u, v in pixels


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


def listed(places: Mapping[str, Place], message: ObjectStates | None = None
           ) -> list[dict[str, Any]]:
    """Return places as the page takes them; with what their message says of how sure they are."""
    known = {one.name: {'state': state, 'confidence': round(confidence, 2)}
             for one, state, confidence in zip(
                 message.objects, message.states, message.confidence)} if message else {}
    return [{'name': name, 'u': round(u, 2), 'v': round(v, 2), **known.get(name, {})}
            for name, (u, v) in places.items()]


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
