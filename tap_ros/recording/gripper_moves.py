# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a recorded gripper closes and opens."""

from collections.abc import Iterator

import numpy as np
from tap_ros.recording.episode import Episode

LEAST_RANGE = 0.1  # of an opening, 0 to 1, that is no noise
_CLOSED, _OPEN = 1 / 3, 2 / 3  # of the range; what lies between is neither yet


def gripper_moves(episode: Episode) -> list[tuple[int, bool]]:
    """
    Return the frames at which the gripper is half way, and whether it closes.

    By its state where that was recorded, else by its commands.
    """
    opening = episode.grippers[:, 3]
    if np.isnan(opening).all():
        opening = np.append(episode.actions[:-1, 3], np.nan)  # the last row is no command
    return list(_moves(opening))


def _moves(opening: np.ndarray) -> Iterator[tuple[int, bool]]:
    """Yield where numbers (T,), NaN where unknown, pass the middle of their range; if down."""
    known = np.flatnonzero(np.isfinite(opening))
    if not len(known) or np.ptp(opening[known]) < LEAST_RANGE:
        return
    opening = np.interp(np.arange(len(opening)), known, opening[known])
    share = (opening - opening.min()) / np.ptp(opening)
    is_open = bool(share[0] > 0.5)
    for t in range(len(share)):
        if share[t] < _CLOSED if is_open else share[t] > _OPEN:
            before = np.flatnonzero((share[:t] > 0.5) == is_open)
            yield int(before[-1]) + 1 if len(before) else t, is_open
            is_open = not is_open
