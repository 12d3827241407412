# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where episodes begin and end in a log, by the marks on /episode.

By header stamps and by log time: a message belongs to an episode whose marks enclose its stamp,
and that is nearest in the log. So neither marks and images that overtake each other on their way
to the recorder, nor a simulated clock that starts anew, mix up episodes.
"""

from dataclasses import dataclass

import numpy as np

MAX_JITTER_NS = 500 * 10**6  # messages may be logged so much before or after the mark they follow
_FAR = 2**62


@dataclass
class Span:
    """The part of the log and of the stamps that belongs to one episode."""

    start_log: int = -_FAR
    end_log: int = _FAR
    start_stamp: int = -_FAR
    end_stamp: int = _FAR
    task: str = ''
    seed: int = 0
    outcome: str = ''


def read_spans(data, marks):
    """Read the marks: a list of spans in the order of the log."""
    if not marks:
        return [Span()]
    spans, current, last_end = [], None, -_FAR
    for log, stamp, event, (task, seed, outcome) in zip(
            data['mark_log'].tolist(), data['mark_stamp'].tolist(),
            data['mark_event'].tolist(), marks, strict=True):
        if event == 0:
            if current is not None:
                current.end_log = log - 1
                if stamp > current.start_stamp:
                    current.end_stamp = stamp - 1
            current = Span(log, _FAR, stamp, _FAR, task, seed, 'interrupted')
            spans.append(current)
        else:
            if current is None:  # recording began after the start of the episode
                current = Span(last_end, task=task, seed=seed)
                spans.append(current)
            current.end_log, current.outcome = log, outcome
            current.end_stamp = stamp or _FAR
            current, last_end = None, log + 1
    return spans


def assign(spans, log, stamps):
    """Return (N,) int64: the episode of each message, -1 for none."""
    start_log, end_log, start_stamp, end_stamp = np.array(
        [(s.start_log, s.end_log, s.start_stamp, s.end_stamp) for s in spans],
        np.int64).reshape(-1, 4).T
    best = np.full(len(log), -1)
    best_distance = np.full(len(log), MAX_JITTER_NS + 1)
    inside = np.searchsorted(start_log, log, 'right') - 1
    for shift in (0, 1, -1):
        candidate = np.clip(inside + shift, 0, len(spans) - 1)
        distance = np.maximum(
            np.maximum(start_log[candidate] - log, log - end_log[candidate]), 0)
        better = (
            (start_stamp[candidate] <= stamps) & (stamps <= end_stamp[candidate])
            & (distance < best_distance))
        best[better], best_distance[better] = candidate[better], distance[better]
    return best
