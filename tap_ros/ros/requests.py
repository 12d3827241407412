# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Requests of a Client made from arrays and names, checked before anything is sent."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
import math
from typing import Any

import numpy as np
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.base.contract import CAMERA_FRAME, object_names
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped
from tap_ros.messages.subgoals import decode_subgoals, Subgoal
from tap_ros.ros.topics import encode_image, encode_objects, to_stamp

FOREVER_S = 1e9  # longer than threads can wait
WAITING = 'waiting'  # a refusal of predict_subgoal begins so while a picture has yet to come


def request_fields(names: Sequence[str] = (), /, **arrays: Any) -> dict[str, Any]:
    """
    Turn pictures (H, W, 3) and pixels (K, 2) into messages; leave out those that are None.

    :param names: of the objects; by default contract.object_names.
    :param arrays: by field; what is called `objects`, or ends so, are pixels.
    :return: {field: message}.
    :raises ConfigError: for other shapes, and for what is no text or number.
    """
    fields: dict[str, Any] = {}
    for name, values in arrays.items():
        if name.endswith('objects') and values is not None:
            pixels = pixels_of(values, name)
            fields[name] = encode_objects(
                [text_of(each, 'the name of an object') for each in (
                    names or object_names(len(pixels)))],
                pixels, None, to_stamp(0), CAMERA_FRAME, ObjectStates.SOURCE_TRACKED)
        elif values is not None:
            picture = np.asarray(values)
            if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
                raise ConfigError(f'{name}: expected a picture, uint8 (height, width, 3), got '
                                  f'{picture.dtype} {picture.shape}')
            fields[name] = encode_image(picture, to_stamp(0), CAMERA_FRAME)
    return fields


def subgoals_of(response: PredictSubgoal.Response) -> list[Subgoal]:
    """Return the subgoals of an answer, their objects in the order of the first one."""
    if not response.subgoals:
        return []
    return decode_subgoals(response, tuple(response.subgoals[0].object_names))


def make_request(kind: Callable[..., Any], fields: Mapping[str, Any]) -> Any:
    """Return a message; raise ConfigError for what one of its fields cannot hold."""
    for name, value in fields.items():
        for text in value if isinstance(value, (list, tuple, set)) else [value]:
            if isinstance(text, str):
                text_of(text, name)
    try:
        return kind(check_fields=True, **fields)
    except AssertionError as error:
        raise ConfigError(escaped(error)) from error


def by_name(pixels: Any) -> Mapping[str, Any]:
    """Return pixels by name; raise ConfigError for what is no mapping."""
    if not isinstance(pixels, Mapping):
        raise ConfigError('expected pixels by the names of objects, {name: (u, v)}, got '
                          f'{escaped(repr(pixels), 60)}')
    return pixels


def text_of(value: Any, what: str) -> str:
    """Return a text; raise ConfigError for what is none that UTF-8 can hold."""
    with suppress(UnicodeError):
        if isinstance(value, str):
            value.encode()
            return value
    raise ConfigError(f'{what}: expected a text, got {escaped(repr(value), 60)}')


def pixels_of(values: Any, what: str) -> np.ndarray:
    """Return pixels (K, 2); raise ConfigError for what is none."""
    try:
        pixels = np.asarray(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        pixels = np.empty(0)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or not np.isfinite(pixels).all():
        raise ConfigError(f'{what}: expected pixels (u, v), two finite numbers for each object, '
                          f'got {escaped(values, 60)}')
    return pixels


def seconds_of(value: Any) -> float:
    """Return a time-out; raise ConfigError for what is no positive number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not (
            0 < value < math.inf):
        raise ConfigError(
            f'timeout_s: expected a positive number of seconds, got {escaped(value, 40)}')
    return min(float(value), FOREVER_S)
