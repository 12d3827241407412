# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where episodes begin and end in a log, by the marks on /episode.

By header stamps and by log time: a message belongs to an episode whose marks enclose its stamp,
and that is nearest in the log. So neither marks and images that overtake each other on their way
to the recorder, nor a simulated clock that starts anew, mix up episodes.

Where something was lost an episode is cut in two: the frames before end as 'interrupted', those
after are an episode of their own with the outcome of the whole. Frames on both sides never stand
next to each other. Where marks may be lost too, frames after the gap belong to the episode whose
end follows; without such an end they are left out.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from tap_ros.recording.damage import EVERYTHING, FAR

Mark = tuple[str, int, str]  # task, seed, outcome

MAX_JITTER_NS = 500 * 10**6  # messages may be logged so much before or after the mark they follow


@dataclass
class Span:
    """The part of the log and of the stamps that belongs to one episode."""

    start_log: int = -FAR
    end_log: int = FAR
    start_stamp: int = -FAR
    end_stamp: int = FAR
    task: str = ''
    seed: int = 0
    outcome: str | None = ''  # None: of frames that may belong to no episode
    first_cut: int | None = None  # log time of the gap where the first part of this one ends


def read_spans(data: dict[str, np.ndarray], marks: Sequence[Mark], pause: float = 0,
               longest: float = 0) -> list[Span]:
    """
    Read the marks: a list of spans in the order of the log.

    :param data: dict with mark_log, mark_stamp, mark_event (N,), frame_log, frame_stamp (F,), and
        gap (G, 3) as losses.gaps.
    :param marks: N triples (task, seed, outcome).
    :param pause: s; without marks, a longer one between two frames begins an episode; 0: none.
    :param longest: s; without marks and pauses, longer episodes are cut into equal parts; 0: none.
    """
    gaps = data['gap'][np.argsort(data['gap'][:, 0], kind='stable')].tolist()
    spans = _marked(data, marks, gaps) if marks else _unmarked(
        data['frame_log'], data['frame_stamp'], int(pause * 1e9), int(longest * 1e9))
    if gaps:
        spans = [part for span in spans for part in _cut(span, gaps)]
        spans = sorted((s for s in spans if s.start_log <= s.end_log), key=lambda s: s.start_log)
    return spans or [Span(outcome=None)]


def in_gaps(gaps: np.ndarray, log: np.ndarray) -> np.ndarray:
    """
    Tell which times lie where messages of any topic may be missing, ends included.

    :param gaps: (G, 3) int64, as losses.gaps gives it.
    :param log: (N,) int64, ns.
    :return: (N,) bool.
    """
    gaps = gaps[gaps[:, 2] == EVERYTHING]
    gaps = gaps[np.argsort(gaps[:, 0], kind='stable')]
    before = np.searchsorted(gaps[:, 0], log, 'right')
    ends = np.append(-FAR - 1, np.maximum.accumulate(gaps[:, 1]))
    return log <= ends[before]


def _marked(data: dict[str, np.ndarray], marks: Sequence[Mark],
            gaps: list[list[int]]) -> list[Span]:
    """Return the spans between marks; where marks may be lost nothing is known until the next."""
    # At the same time starts come before gaps and ends behind: what cannot be told is left out.
    events: list[tuple[int, int, int, int, Mark]] = [
        (log, 2 * (event != 0), stamp, event, about) for log, stamp, event, about in zip(
            data['mark_log'].tolist(), data['mark_stamp'].tolist(), data['mark_event'].tolist(),
            marks, strict=True)]
    events += [(start, 1, end, 0, ('', 0, '')) for start, end, cuts in gaps if cuts == EVERYTHING]
    spans, current, last_end = [], None, -FAR
    for log, order, stamp, event, about in sorted(events, key=lambda e: e[:2]):
        unsure = current is not None and current.outcome is None
        if order == 1:
            if current is not None:
                current.end_log = log - 1
            last_end = max(last_end, stamp + 1, log)
            current = Span(last_end, outcome=None)
            spans.append(current)
        elif event == 0:
            if current is not None:
                current.end_log = log - 1
                if stamp > current.start_stamp:
                    current.end_stamp = stamp - 1
            current = Span(log, FAR, stamp, FAR, about[0], about[1], 'interrupted')
            spans.append(current)
        else:
            if current is None or unsure:  # the start of the episode was not recorded, or is lost
                if unsure:
                    spans.pop()
                current = Span(last_end, task=about[0], seed=about[1])
                spans.append(current)
            current.end_log, current.outcome = log, about[2]
            current.end_stamp = stamp or FAR
            current, last_end = None, log + 1
    return spans


def _unmarked(log: np.ndarray, stamps: np.ndarray, pause: int, longest: int) -> list[Span]:
    """Return spans that end where the camera pauses, or its clock was set; times in ns."""
    order = np.argsort(log, kind='stable')
    log, stamps = log[order], stamps[order]
    steps = np.diff(stamps)  # a clock that is set back begins another episode, too
    begins = np.flatnonzero((steps > pause) | (steps < -MAX_JITTER_NS)) + 1 if pause else (
        np.empty(0, int))
    if not len(begins) and longest and len(stamps):
        since = np.maximum.accumulate(stamps) - stamps[0]
        parts = max(-(-int(since[-1]) // longest), 1)  # rounded up
        begins = np.unique(np.searchsorted(since, since[-1] / parts * np.arange(1, parts)))
    edges = [0, *begins.tolist(), len(log)]
    spans = [Span(int(log[first]), int(log[end - 1]))
             for first, end in zip(edges, edges[1:]) if end > first] or [Span()]
    spans[0].start_log, spans[-1].end_log = -FAR, FAR
    return spans


def _cut(span: Span, gaps: list[list[int]]) -> Iterator[Span]:
    """Yield the parts of a span between gaps."""
    interrupted = 'interrupted' if span.task or span.outcome else span.outcome
    first = bisect_right(gaps, span.start_log, key=lambda gap: gap[0])
    for start, end, cuts in gaps[first:bisect_right(gaps, span.end_log, key=lambda gap: gap[0])]:
        yield replace(span, end_log=start - 1, outcome=interrupted)
        first_cut = start if span.first_cut is None else span.first_cut
        span = replace(span, start_log=max(end + 1, start),
                       first_cut=None if cuts == EVERYTHING else first_cut)
    yield span


def assign(spans: Sequence[Span], log: np.ndarray, stamps: np.ndarray) -> np.ndarray:
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
