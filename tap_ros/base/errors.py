# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The errors of this package.

Every message names what was wrong and what would be right. Catch TapError to catch them all.
"""

from collections.abc import Mapping
from dataclasses import fields
import math
from typing import Any, get_args, get_origin, Literal

from tap_ros.base.text import escaped


class TapError(Exception):
    """Base of all errors raised on purpose by this package."""


class ConfigError(TapError):
    """A setting, parameter or command-line argument cannot be used."""


class ImageError(TapError):
    """A picture has the wrong type, shape, size, encoding or length."""


class RecordingError(TapError):
    """A recording is missing, empty, damaged, or lacks a topic."""


class StorageError(TapError):
    """A file cannot be written: the disk is full or gone, or another process is writing there."""


class WeightsError(TapError):
    """A weights file is missing, damaged, or made for something else."""


class SceneError(TapError):
    """A task, seed or scene cannot be set up, or an action cannot be applied."""


class KinematicsError(SceneError):
    """An arm cannot be where, or as fast, as it should."""


class EngineError(TapError):
    """A task could not be run to its end, since its workers were killed."""


class PlanningError(TapError):
    """The planner was given states, maps or goals that cannot be planned with."""


class TrackingError(TapError):
    """Objects cannot be selected in a picture, or followed in it."""


def check_fields(config: Any, ranges: Mapping[str, tuple[float, float]]) -> None:
    """
    Raise ConfigError for fields of a dataclass that are none of the choices, or out of range.

    :param ranges: least and largest value of numbers, by the name of the field.
    """
    for field in fields(config):
        value, wanted = getattr(config, field.name), ''
        if get_origin(field.type) is Literal and value not in get_args(field.type):
            wanted = 'one of ' + ', '.join(get_args(field.type))
        low, high = ranges.get(field.name, (-math.inf, math.inf))
        if field.name in ranges and not low <= value <= high:
            wanted = f'{low}..{high}' if high < math.inf else f'at least {low}'
        if wanted:
            raise ConfigError(
                f'{field.name}: expected {wanted}, got {escaped(repr(value), 60)}')


class RecordingWarning(UserWarning):
    """A recording is damaged, but part of it could be read."""
