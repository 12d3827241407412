# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a browser may ask for: JSON, checked field by field."""

from collections.abc import Mapping
from dataclasses import dataclass
import json
from typing import Any

from tap_ros.errors import TapError
from tap_ros.text import escaped

MAX_SAMPLES, MAX_LEVELS = 16, 4  # of the page's sliders; the services allow more
MAX_NAME = 100  # characters
LARGEST = 1e6  # of a pixel


class CommandError(TapError):
    """A browser asked for what cannot be done."""


@dataclass(frozen=True)
class Reset:
    """Start a scene of the simulator; an empty task is that of now."""

    task: str
    seed: int


@dataclass(frozen=True)
class Predict:
    """Predict subgoals from the newest pictures."""

    samples: int
    levels: int
    seed: int


@dataclass(frozen=True)
class Reach:
    """Push the objects to the goal; mode is 'direct' or 'subgoal'."""

    mode: str
    samples: int
    levels: int
    seed: int


@dataclass(frozen=True)
class Cancel:
    """End the goal in progress."""


@dataclass(frozen=True)
class Move:
    """Put an object of the goal picture to a pixel (u, v) of it."""

    name: str
    u: float
    v: float


@dataclass(frozen=True)
class Photograph:
    """Take the camera's newest picture as the goal."""


Command = Reset | Predict | Reach | Cancel | Move | Photograph


def parse_command(text: str | bytes) -> Command:
    """
    Read what a browser sent.

    :param text: JSON such as {"do": "reach", "mode": "direct", "samples": 1, "levels": 1,
        "seed": 0}.
    :return: one of the dataclasses above.
    :raises CommandError: if it is none; the message names the field and what would be right.
    """
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError):
        raise CommandError('a command is a JSON object') from None
    if not isinstance(fields, dict):
        raise CommandError('a command is a JSON object')
    do = fields.get('do')
    if do == 'reset':
        return Reset(_text(fields, 'task'), _whole(fields, 'seed', 0, 2**62))
    if do == 'predict':
        return Predict(*_numbers(fields))
    if do == 'reach':
        mode = _text(fields, 'mode')
        if mode not in ('direct', 'subgoal'):
            raise CommandError(f"mode: expected 'direct' or 'subgoal', got {escaped(mode, 40)!r}")
        return Reach(mode, *_numbers(fields))
    if do == 'cancel':
        return Cancel()
    if do == 'move':
        return Move(_text(fields, 'name'), _real(fields, 'u'), _real(fields, 'v'))
    if do == 'photograph':
        return Photograph()
    raise CommandError(f'do: expected reset, predict, reach, cancel, move or photograph, got '
                       f'{escaped(do, 40)!r}')


def _numbers(fields: Mapping[str, Any]) -> tuple[int, int, int]:
    return (_whole(fields, 'samples', 1, MAX_SAMPLES), _whole(fields, 'levels', 1, MAX_LEVELS),
            _whole(fields, 'seed', 0, 2**62))


def _text(fields: Mapping[str, Any], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str) or len(value) > MAX_NAME:
        raise CommandError(f'{name}: expected a text of at most {MAX_NAME} characters')
    return value


def _whole(fields: Mapping[str, Any], name: str, low: int, high: int) -> int:
    value = fields.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise CommandError(f'{name}: expected a whole number from {low} to {high}')
    return value


def _real(fields: Mapping[str, Any], name: str) -> float:
    value = fields.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < LARGEST:
        raise CommandError(f'{name}: expected a number')
    return float(value)
