# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether predictions show the frame that a person marked, and how well."""

from collections.abc import Sequence

import numpy as np
from tap_ros.evaluation.intervals import Interval, mean_interval, share_interval
from tap_ros.recording.marks import Mark
from tap_ros.training.marks import chance


def is_hit(marks: Sequence[Mark], frame: int, off: int = 0) -> bool:
    """Return whether a frame is within one of the marks of its episode, or so many beside it."""
    return any(first - off <= frame <= last + off for first, last in marks)


def seconds_off(marks: Sequence[Sequence[Mark]], stamps: Sequence[np.ndarray],
                matched: np.ndarray) -> np.ndarray:
    """
    Say how far each matched frame is from the nearest mark of its episode.

    :param marks: of each of N marked episodes; stamps: of each its frames' (T,) ns.
    :param matched: (N,) frames that the predictions match.
    :return: (N,) s; 0 within a mark.
    """
    return np.array([min(max(float(at[first] - at[t]), float(at[t] - at[last]), 0)
                         for first, last in each) / 1e9
                     for each, at, t in zip(marks, stamps, matched.tolist())])


def score_hits(marks: Sequence[Sequence[Mark]], lengths: np.ndarray,
               matched: np.ndarray) -> dict[str, list[Interval]]:
    """
    Say in which share of episodes the matched frame is a marked one, or at most one beside it.

    :param marks: of each of N marked episodes; any of several counts.
    :param lengths: (N,) frames of the episodes.
    :param matched: (N,) frames that the predictions match.
    :return: of the prediction, the frame half way and a random frame between start and goal: the
        shares of hits and of near ones, 0 to 1.
    """
    found = {name: [share_interval([is_hit(each, frame, off) for each, frame in zip(
        marks, frames.tolist())]) for off in (0, 1)]
        for name, frames in (('prediction', matched), ('middle', (lengths - 1) // 2))}
    return found | {'random': [mean_interval([
        min(1.0, sum(chance(mark, length, off) for mark in each))
        for each, length in zip(marks, lengths.tolist())]) for off in (0, 1)]}
