# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a recorded gripper closes and opens."""

from collections.abc import Iterator

import numpy as np
from tap_ros.recording.episode import Episode

LEAST_RANGE = 0.1  # of an opening, 0 to 1, that is no noise
_LEAST_TURN = 0.02  # rad or m, likewise of joints
_HANDS = 'hand', 'finger', 'gripper'  # in the names of signals
_CLOSED, _OPEN = 1 / 3, 2 / 3  # of the range; what lies between is neither yet


def gripper_moves(episode: Episode) -> list[tuple[int, bool | None]]:
    """
    Return the frames at which the gripper is half way, and whether it closes; None: unknown.

    By its state, else by its commands, else by what the joints of a hand among the signals do
    most, of which nothing tells the way.
    """
    commands = np.append(episode.actions[:-1, 3], np.nan)  # the last row is none
    return (list(_moves(episode.grippers[:, 3], LEAST_RANGE))
            or list(_moves(commands, LEAST_RANGE))
            or [(t, None) for t, _ in _moves(_of_signals(episode), _LEAST_TURN)])


def _of_signals(episode: Episode) -> np.ndarray:
    """Return how far the joints of a hand are along their first principal axis, (T,)."""
    hands = [k for k, name in enumerate(episode.signal_names) if any(
        part in name.lower() for part in _HANDS)]
    hands = [k for k in hands if not episode.signal_names[k].startswith('action')] or hands
    joints = np.nan_to_num(
        np.empty((len(episode), 0)) if episode.signals is None else episode.signals[:, hands])
    if not joints.shape[1]:
        return np.zeros(len(episode))
    away, size, _ = np.linalg.svd(joints - joints.mean(0), full_matrices=False)
    return np.asarray(away[:, 0] * size[0])


def _moves(opening: np.ndarray, least: float) -> Iterator[tuple[int, bool]]:
    """
    Yield where numbers (T,) pass the middle of their range, and if down.

    :param opening: NaN where unknown.
    :param least: range below which there is no move.
    """
    known = np.flatnonzero(np.isfinite(opening))
    if not len(known) or np.ptp(opening[known]) < least:
        return
    opening = np.interp(np.arange(len(opening)), known, opening[known])
    share = (opening - opening.min()) / np.ptp(opening)
    is_open = bool(share[0] > 0.5)
    for t in range(len(share)):
        if share[t] < _CLOSED if is_open else share[t] > _OPEN:
            before = np.flatnonzero((share[:t] > 0.5) == is_open)
            yield int(before[-1]) + 1 if len(before) else t, is_open
            is_open = not is_open
