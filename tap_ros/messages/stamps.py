# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps of messages in nanoseconds, and what their order and distance mean, live and recorded."""

from typing import Any, Protocol

import numpy as np

PROOF = 3  # messages in a row that prove that the clock of a topic has jumped
MAX_GAP = 0.35  # s; joint states farther from a picture in time do not say where the arm was


class Stamp(Protocol):
    """A builtin_interfaces/Time, live or recorded."""

    sec: int
    nanosec: int


def to_nanoseconds(stamp: Stamp) -> int:
    """Return the nanoseconds of a stamp."""
    return stamp.sec * 10**9 + stamp.nanosec


def stamp_fields(stamp: Stamp | int) -> dict[str, int]:
    """Return the fields of a builtin_interfaces/Time, from one or from nanoseconds."""
    seconds, rest = divmod(
        int(stamp) if isinstance(stamp, (int, np.integer)) else to_nanoseconds(stamp), 10**9)
    return {'sec': seconds, 'nanosec': rest}


def header_fields(stamp: Stamp | int, frame_id: str) -> dict[str, Any]:
    """Return the fields of a std_msgs/Header."""
    return {'stamp': stamp_fields(stamp), 'frame_id': frame_id}
