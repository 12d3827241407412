# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where episodes begin and end in a log, by the marks on /episode.

By header stamps and by log time: a message belongs to an episode whose marks enclose its stamp,
and that is nearest in the log. So neither marks and images that overtake each other on their way
to the recorder, nor a simulated clock that starts anew, mix up episodes.

Where messages were lost an episode is cut in two: the frames before end as 'interrupted', those
after are an episode of their own with the outcome of the whole. Frames on both sides never stand
next to each other. Frames after the gap belong to the episode whose end follows; without such an
end they are left out.
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import warnings

import numpy as np
from tap_ros.base.errors import RecordingWarning
from tap_ros.recording.columns import Mark, Track
from tap_ros.recording.defects import FAR
from tap_ros.recording.reading import Reading

MAX_JITTER_NS = 500 * 10**6  # messages may be logged so much before or after the mark they follow
_LATE_NS = 5 * 10**9  # likewise where stamps alone tell episodes apart, as no clock begins anew
_ROUND = 5  # pictures in a row that are as before are no chance
_LEAST_PAUSE = 0.5  # s, between two demonstrations
WALL_NS = 10**18  # 2001: clocks of simulations, and those since a start, show less


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


def read_spans(tracks: Mapping[str, Track], marks: Sequence[Mark], gaps: np.ndarray,
               rounds: np.ndarray, reading: Reading, source: str) -> list[Span]:
    """
    Read the marks: a list of spans in the order of the log.

    :param tracks: by name, sorted by log time.
    :param marks: (task, seed, outcome) of each mark, by its row of values.
    :param gaps: (G, 2) as defects.gaps.
    :param rounds: rows of frames that begin a round, see find_rounds.
    :param reading: Reading; without marks, a longer pause than its gap between two frames begins
        an episode; without pauses, longer episodes than it says are cut into equal parts.
    :param source: what warnings call the recording.
    """
    frame = tracks['frame']
    pauses = frame.stamp[rounds] - frame.stamp[rounds - 1]
    if count := int((pauses <= (reading.gap or np.inf) * 1e9).sum()):
        warnings.warn(
            f'{source}: its pictures begin anew, {count} times, as where a playback in a loop was '
            'recorded; each round is an episode of its own', RecordingWarning, stacklevel=4)
    if not marks and reading.gap:
        _propose_gap(frame.stamp, reading, source)
    places = gaps[np.argsort(gaps[:, 0], kind='stable')].tolist()
    spans = _marked(tracks['mark'], marks, places) if marks else _unmarked(
        frame.log, frame.stamp, rounds, int(reading.gap * 1e9), int(reading.episode_seconds * 1e9))
    if places:
        spans = [part for span in spans for part in _cut(span, places)]
        spans = sorted((s for s in spans if s.start_log <= s.end_log), key=lambda s: s.start_log)
    return spans or [Span(outcome=None)]


def in_gaps(gaps: np.ndarray, log: np.ndarray) -> np.ndarray:
    """
    Tell which times lie where messages of any topic may be missing, ends included.

    :param gaps: (G, 2) int64, as defects.gaps gives it.
    :param log: (N,) int64, ns.
    :return: (N,) bool.
    """
    gaps = gaps[np.argsort(gaps[:, 0], kind='stable')]
    before = np.searchsorted(gaps[:, 0], log, 'right')
    ends = np.append(-FAR - 1, np.maximum.accumulate(gaps[:, 1]))
    return log <= ends[before]


def _marked(mark: Track, marks: Sequence[Mark], gaps: list[list[int]]) -> list[Span]:
    """Return the spans between marks; where marks may be lost nothing is known until the next."""
    # At the same time starts come before gaps and ends behind: what cannot be told is left out.
    events: list[tuple[int, int, int, int, Mark]] = [
        (log, 2 * (event != 0), stamp, event, marks[row]) for log, stamp, event, row in zip(
            *(a.tolist() for a in (mark.log, mark.stamp, mark.index, mark.first)), strict=True)]
    events += [(start, 1, end, 0, ('', 0, '')) for start, end in gaps]
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


def find_rounds(checksums: np.ndarray) -> np.ndarray:
    """
    Find where a playback that was recorded began anew.

    :param checksums: (N,) of the pictures, in the order in which they were written.
    :return: rows from which on pictures are as before, in their order: (R,) int64.
    """
    places: dict[float, int] = {}  # in its round, by checksum
    at, known, place = [], [], -1
    for checksum in checksums.tolist():
        known.append(checksum in places)
        place = places.setdefault(checksum, place + 1)
        at.append(place)
    found = [i for i in (np.flatnonzero(np.diff(at) <= -_ROUND) + 1).tolist()
             if (part := at[i:i + 2 * _ROUND]) == sorted(part)
             and len({p for p, old in zip(part, known[i:]) if old}) >= min(
                 _ROUND, max(len(part), 2))]
    return np.array(found, np.int64)


def _unmarked(log: np.ndarray, stamps: np.ndarray, rounds: np.ndarray, pause: int,
              longest: int) -> list[Span]:
    """Return spans that end where the camera pauses, or begins a round; times in ns."""
    begins = np.flatnonzero(np.diff(stamps) > pause) + 1 if pause else np.empty(0, int)
    begins = np.union1d(begins, rounds)
    if not len(begins) and longest and len(stamps):
        since = np.maximum.accumulate(stamps) - stamps[0]
        parts = max(-(-int(since[-1]) // longest), 1)  # rounded up
        begins = np.unique(np.searchsorted(since, since[-1] / parts * np.arange(1, parts)))
    edges = [0, *begins.tolist(), len(log)]
    # A pause belongs in halves to both: what is about the first picture may be logged before it.
    spans = [Span(int(log[first]) - int(log[first] - log[first - 1]) // 2, int(log[end - 1]))
             for first, end in zip(edges, edges[1:]) if end > first] or [Span()]
    spans[0].start_log, spans[-1].end_log = -FAR, FAR
    return spans


def _propose_gap(stamps: np.ndarray, reading: Reading, source: str) -> None:
    """Say which gap tells demonstrations apart, where the pauses between them are other ones."""
    steps = np.sort(np.diff(stamps)) / 1e9
    steps = steps[steps > 0]
    longer = steps[1:] >= max(_LEAST_PAUSE, 5 * np.median(steps)) if len(steps) else np.empty(0)
    if not longer.any():
        return
    ratios = np.where(longer, steps[1:] / steps[:-1], 0)
    last = int(ratios.argmax())  # the step before the widest hole in their histogram
    pauses, count = steps[last + 1:], int((steps > reading.gap).sum())
    if ratios[last] < 2 or len(pauses) == count or len(pauses) > len(steps) // 3:
        return
    how = (f'they are cut at {count} pauses of more than {reading.gap:g} s' if count else
           f'none pauses for {reading.gap:g} s')
    warnings.warn(
        f'{source}: no marks tell demonstrations apart, {how} (--gap); between its pictures are '
        f'{len(pauses)} pauses of {pauses[0]:.1f} to {pauses[-1]:.1f} s: --gap '
        f'{np.sqrt(steps[last] * pauses[0]):.2g} cuts there', RecordingWarning, stacklevel=4)


def _cut(span: Span, gaps: list[list[int]]) -> Iterator[Span]:
    """Yield the parts of a span between gaps."""
    interrupted = 'interrupted' if span.task or span.outcome else span.outcome
    first = bisect_right(gaps, span.start_log, key=lambda gap: gap[0])
    for start, end in gaps[first:bisect_right(gaps, span.end_log, key=lambda gap: gap[0])]:
        yield replace(span, end_log=start - 1, outcome=interrupted)
        span = replace(span, start_log=max(end + 1, start))
    yield span


def assign(spans: Sequence[Span], track: Track) -> np.ndarray:
    """Return (N,) int64: the episode of each message, -1 for none."""
    log, stamps = track.log, track.stamp
    start_log, end_log, start_stamp, end_stamp = np.array(
        [(s.start_log, s.end_log, s.start_stamp, s.end_stamp) for s in spans],
        np.int64).reshape(-1, 4).T
    best = np.full(len(log), -1)
    told = start_stamp[0] > WALL_NS and (np.diff(start_stamp) > 0).all() and (
        (end_stamp < FAR) | (end_log == FAR)).all()
    best_distance = np.full(len(log), (_LATE_NS if told else MAX_JITTER_NS) + 1)
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
