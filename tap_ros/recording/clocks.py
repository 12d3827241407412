# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Correct stamps and log times of recorded messages where they are wrong.

Only the order in which messages were written is always right. Log times come from one clock, the
recorder's, which may be set. Stamps come from the clock of each topic's driver, which may jump,
stand still or differ from the camera's. Every message is kept, each correction gives a warning
that names the topic, and times that are right are not changed.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import warnings

import numpy as np
from tap_ros.messages.stamps import PROOF
from tap_ros.recording.columns import Track
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.jumps import APART_NS, settle, windows
from tap_ros.recording.log_times import how_set, one_log
from tap_ros.text import escaped

_OVERTAKEN_NS = 10**8  # a frame may be logged so long before the mark that precedes it
_ANSWER_NS = 5 * 10**9  # what is about a picture may be logged so much later
_BEHIND_NS = 35 * 10**7  # only a camera is late; what else is behind it has another clock
_MANY = 10  # messages of one stamp, of which no driver sends so many together
_AROUND, _SMOOTH = 9, 15  # messages that tell how far two clocks are apart
_STREAMS = ('frame', 'twist', 'joint', 'arm', 'object')
_ANSWERS = ('mask', 'object', 'twist')  # may have the stamp of the picture that they are about

Anew = Callable[[Track], Callable[[np.ndarray, np.ndarray], np.ndarray]]


def put_right(tracks: dict[str, Track], source: str, topics: dict[str, str],
              gaps: np.ndarray) -> dict[str, Track]:
    """
    Return the messages of all names, sorted by log time.

    :param tracks: by name, in the order in which they were written; stamps 0 where there are none.
    :param source: what warnings call the recording.
    :param topics: by name; likewise.
    :param gaps: (G, 2) as damage.gaps: where marks may be lost.
    """
    said: list[str] = []
    called = {name: f'topic {escaped(topics.get(name, name))}' for name in tracks}
    called['arm'] = called['joint']
    tracks = one_log(dict(tracks), said)
    before, anew = tracks['frame'], _anew(tracks['mark'], gaps)
    tracks['frame'] = frame = _frames(before, anew, called['frame'], said)
    if frame.stamp is not before.stamp:
        for name in _ANSWERS:
            tracks[name] = _restamped(tracks[name], before, frame)
        tracks['mark'] = _marked(tracks['mark'], before, frame)
    for name in _STREAMS[1:]:
        tracks[name] = _stamped(name, tracks[name], frame, anew, called[name], said)
    _one_clock(tracks, called, said)
    for text in dict.fromkeys(said):
        warnings.warn(f'{escaped(source)}: {text}', RecordingWarning, stacklevel=3)
    return {name: _by_log(track) for name, track in tracks.items()}


def _by_log(track: Track) -> Track:
    """Return messages sorted by log time."""
    return track.take(np.argsort(track.log, kind='stable'))


def _anew(mark: Track, gaps: np.ndarray) -> Anew:
    """
    Return a function of a Track that tells where its clock begins anew between two episodes.

    As that of a simulation does when it is reset. Such a jump is right, and the stamps of the
    marks around it, which jump alike, show that it is.

    :param mark: the marks of episodes.
    :param gaps: (G, 2) as damage.gaps: where marks may be lost.
    :return: Track -> ((N,) rows before places, (N,) rows behind them) -> (N,) bool.
    """
    def distance(stamp: np.ndarray, log: np.ndarray, k: np.ndarray) -> np.ndarray:
        went_on = stamp + mark.log[k] - log
        near = np.clip(mark.stamp[k], np.minimum(stamp, went_on), np.maximum(stamp, went_on))
        return np.abs(mark.stamp[k] - near)

    def of(track: Track) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        def tell(before: np.ndarray, after: np.ndarray) -> np.ndarray:
            if not len(mark):
                return np.zeros(len(before), bool)
            stamp, log = track.stamp, track.log
            following = np.searchsorted(mark.order, track.order[before], 'right')
            last = np.searchsorted(mark.order, track.order[after]) - 1
            started = np.maximum(following - 1, 0)
            outside = (last >= following) | (following == 0) | (mark.index[started] != 0) | (
                np.abs(log[after] - mark.log[started]) < _OVERTAKEN_NS)
            lost = ((gaps[:, :1] <= log[after]) & (gaps[:, 1:] >= log[before])).any(0)
            agrees = np.zeros(len(before), bool)
            for k in (np.maximum(last, 0), np.minimum(last + 1, len(mark) - 1)):
                behind = distance(stamp[after], log[after], k)
                agrees |= (behind < APART_NS) & (behind <= distance(stamp[before], log[before], k))
            return (outside | lost) & (agrees if mark.stamp.any() else last >= following)
        return tell
    return of


def _frames(frame: Track, anew: Anew, called: str, said: list[str]) -> Track:
    """Return the frames, those sent again left out, with stamps that increase."""
    if len(frame) < 2:
        return frame
    if not frame.stamp.any():  # it has none
        return replace(frame, stamp=_increasing(frame.log))
    same = np.append(False, (np.diff(frame.stamp) == 0) & (frame.stamp[1:] != 0))
    again = same & np.append(False, np.diff(frame.picked()[:, 0]) == 0)
    if again.any() and (same == again).all() and np.ptp(frame.stamp):
        frame = frame.take(np.flatnonzero(~again))
        same = np.zeros(len(frame), bool)
    zero = _unstamped(frame)
    settled = settle(frame.stamp, frame.log, ~(same | zero), anew(frame))
    if settled is None:
        back = int((np.diff(frame.stamp) < 0).sum())
        said.append(f'{called}: of {len(frame)} stamps {int(same.sum())} are repeated, '
                    f'{int(zero.sum())} are zero and {back} go back; its pictures are put in '
                    'order by log time')
        return replace(frame, stamp=_increasing(frame.log))
    _say_settled(settled.jumps, settled.bogus, len(frame), called, said)
    return frame if settled.stamp is frame.stamp else replace(frame, stamp=settled.stamp)


def _unstamped(track: Track) -> np.ndarray:
    """Tell which (N,) stamps of zero mean that there is none, and not a clock that begins."""
    zero = track.stamp == 0
    rows = np.flatnonzero(~zero)
    if not zero.any() or not len(rows):
        return zero
    after = rows[np.minimum(np.searchsorted(rows, np.flatnonzero(zero)), len(rows) - 1)]
    zero[zero] = track.stamp[after] - (track.log[after] - track.log[zero]) > APART_NS
    return zero


def _say_settled(jumps: Sequence[int], bogus: int, count: int, called: str,
                 said: list[str]) -> None:
    """Say what was wrong with the stamps of a topic."""
    if jumps:
        said.append(f'{called}: its clock {how_set(jumps)}')
    if bogus:
        said.append(f'{called}: {bogus} of {count} stamps cannot be right (zero, repeated or far '
                    'from all around); log times take their place')


def _stamped(name: str, track: Track, frame: Track, anew: Anew, called: str,
             said: list[str]) -> Track:
    """Return states or commands with stamps that can be compared with those of frames."""
    if not len(frame) or not len(track):
        return track
    shown = _by_log(frame)
    newest = np.maximum(np.searchsorted(shown.log, track.log, 'right') - 1, 0)
    by_log = track.log + (shown.stamp - shown.log)[newest]
    repeats = (np.diff(track.stamp) == 0) & (track.stamp[1:] != 0)
    if len(track) > PROOF and name != 'object' and repeats.any():
        values = track.picked()
        differ = repeats & ~np.isclose(values[1:], values[:-1], equal_nan=True).all(1)
        if differ.mean() > 0.5:  # they are not the same ones, sent again
            said.append(f'{called}: {int(repeats.sum())} of {len(track)} stamps are repeated; log '
                        'times are taken')
            return replace(track, stamp=by_log)
        if name in ('joint', 'arm'):
            track = _going_on(track, repeats, differ, called, said)
    zero = track.stamp == 0
    if zero.all() and name in ('joint', 'arm'):
        return replace(track, stamp=by_log)
    if zero.any():  # a command answers a frame
        track = replace(track, stamp=np.where(
            zero, by_log if name in ('joint', 'arm') else shown.stamp[newest], track.stamp))
    settled = settle(track.stamp, track.log, np.ones(len(track), bool), anew(track), forward=False)
    if settled is None:
        said.append(f'{called}: its stamps jump to and fro; log times are taken')
        return replace(track, stamp=by_log)
    _say_settled(settled.jumps, settled.bogus, len(track), called, said)
    return track if settled.stamp is track.stamp else replace(track, stamp=settled.stamp)


def _going_on(track: Track, repeats: np.ndarray, differ: np.ndarray, called: str,
              said: list[str]) -> Track:
    """
    Return states whose stamps go on, by log time, where they stand still for many messages.

    :param repeats: (N - 1,) bool: which messages have the stamp of the one before.
    :param differ: (N - 1,) bool: those of them that have other values.
    """
    again = np.append(False, repeats)
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(track))))
    many = (np.bincount(first) > _MANY) & (np.bincount(first, np.append(False, differ)) > PROOF)
    stands = again & many[first]
    if not stands.any():
        return track
    said.append(f'{called}: {int(stands.sum())} of {len(track)} stamps are repeated; log times '
                'take their place')
    since = track.log - track.log[first]
    return replace(track, stamp=np.where(stands, track.stamp[first] + since, track.stamp))


def _restamped(track: Track, before: Track, after: Track) -> Track:
    """Return what is about pictures with the stamps that these have now."""
    if not len(track) or not len(after):
        return track
    old = before.stamp[np.searchsorted(before.order, after.order)]
    order = np.lexsort((after.order, old))
    stamps, places = old[order], after.order[order]
    first, last = (np.searchsorted(stamps, track.stamp, side) for side in ('left', 'right'))
    # Of pictures of one stamp that which was written last before it, or else the first.
    keys = np.lexsort((np.append(places, track.order), np.append(stamps, track.stamp)))
    rank = np.empty(len(keys), np.int64)
    rank[keys] = np.cumsum(keys < len(stamps))
    found = order[np.clip(rank[len(stamps):] - 1, first, np.maximum(last - 1, first)).clip(
        max=len(order) - 1)]
    later = track.log - after.log[found]
    known = (last > first) & (later < _ANSWER_NS) & (later > -_OVERTAKEN_NS)
    return replace(track, stamp=np.where(known, after.stamp[found], track.stamp))


def _marked(mark: Track, before: Track, after: Track) -> Track:
    """Return marks moved with the frames next to them, where that brings both closer."""
    if not len(mark) or not len(after):
        return mark
    moved = after.stamp - before.stamp[np.searchsorted(before.order, after.order)]
    i = np.searchsorted(after.order, mark.order) - (mark.index != 0)
    i = np.clip(i, 0, len(after) - 1)
    new = mark.stamp + moved[i]
    expected = after.stamp[i], after.stamp[i] + mark.log - after.log[i]
    old_apart, new_apart = (
        np.abs(one - np.clip(one, np.min(expected, 0), np.max(expected, 0)))
        for one in (mark.stamp, new))
    return replace(mark, stamp=np.where(
        (mark.stamp != 0) & (new_apart < old_apart), new, mark.stamp))


def _one_clock(tracks: dict[str, Track], called: dict[str, str], said: list[str]) -> None:
    """Bring the stamps of topics to the clock of the camera, by log time, where it is another."""
    frame, shifts, known = tracks['frame'], {}, 0
    for name in (*_STREAMS[1:], 'mark'):
        track = tracks[name]
        rows = np.flatnonzero(track.stamp != 0)
        if len(frame) and len(rows):
            known += 1
            shift = _apart(track.take(rows), frame, name)
            if shift.any():
                shifts[name] = shift
                stamp = track.stamp.copy()
                stamp[rows] -= shift
                tracks[name] = replace(track, stamp=stamp)
                size, count = np.median(shift[shift != 0]), np.count_nonzero(shift)
                said.append(
                    f'{called[name]}: the clock of {count} of {len(rows)} messages is '
                    f'{abs(size) / 1e9:.2f} s {"ahead of" if size > 0 else "behind"} that of the '
                    'camera; they are brought together by log time')
    if shifts and len(shifts) == known:  # the camera's is the odd one
        amount = int(np.median(next(iter(shifts.values()))))
        for name in ('goal', 'goal_mask', 'goal_object'):
            track = tracks[name]
            tracks[name] = replace(track, stamp=np.where(
                track.stamp == 0, 0, track.stamp - amount))


def _apart(track: Track, frame: Track, name: str) -> np.ndarray:
    """
    Return (N,) int64 ns by which the clock of each message is ahead of the camera's, 0: alike.

    A message that was written between two frames is expected to have a stamp between theirs.
    Messages that repeat stamps of frames are of the camera's clock, however late they are.

    :param name: marks of an episode's start precede frames, those of its end follow; commands
        answer them.
    """
    shift = np.zeros(len(track), np.int64)
    behind = np.searchsorted(frame.order, track.order)
    after, before = np.minimum(behind, len(frame) - 1), np.maximum(behind - 1, 0)
    from_before, from_after = (
        frame.stamp[rows] + track.log - frame.log[rows] for rows in (before, after))
    ends = (from_before, from_after, frame.stamp[before], frame.stamp[after])
    if name == 'mark':
        return _marks_apart(track, frame, before, after)
    low, high = np.min(ends, 0), np.max(ends, 0)
    apart = track.stamp - np.clip(track.stamp, low, high)
    inside = np.flatnonzero((behind > 0) & (behind < len(frame)) & (
        high - low <= max(APART_NS, 2 * np.median(np.diff(frame.stamp, append=0)))))
    if not ((apart > APART_NS) | (apart < -_BEHIND_NS)).any() or not len(inside) or (
            np.isin(track.stamp[inside], frame.stamp).mean() > 0.5):
        return shift
    smooth = windows(apart[inside], _AROUND)
    off = (smooth > APART_NS) | (smooth < -_BEHIND_NS)
    nearest = np.where(np.abs(track.log - frame.log[before]) <= np.abs(
        track.log - frame.log[after]), from_before, from_after)
    for rows in np.split(np.arange(len(inside)), np.flatnonzero(np.diff(off)) + 1):
        if off[rows[0]] and len(rows) > PROOF:
            at = inside[rows]  # the clock was set in the middle of what nothing is known of
            first = 0 if rows[0] == 0 else (inside[rows[0] - 1] + 1 + at[0]) // 2
            last = len(track) if rows[-1] == len(inside) - 1 else (
                inside[rows[-1] + 1] + 1 + at[-1]) // 2
            shift[first:last] = np.interp(np.arange(first, last), at, windows(
                (track.stamp - nearest)[at], _SMOOTH)).astype(np.int64)
            if name == 'twist':
                low, high = frame.stamp[before[at]], frame.stamp[after[at]] - 1
                shift[at] = track.stamp[at] - np.clip(track.stamp[at] - shift[at], low, np.maximum(
                    low, high))
    return shift


def _marks_apart(mark: Track, frame: Track, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the same as _apart for marks: too few for a median, each is judged by itself."""
    start, sides = mark.index == 0, []
    for own, other in ((after, before), (before, after)):
        rows = np.where(start, own, other)
        expected = frame.stamp[rows] + mark.log - frame.log[rows]
        away = mark.stamp - np.clip(mark.stamp, *np.sort([frame.stamp[rows], expected], 0))
        sides.append((away, expected, np.abs(mark.log - frame.log[rows])))
    (apart, expected, _), (other_apart, _, near) = sides
    apart = np.where((near < _OVERTAKEN_NS) & (np.abs(other_apart) < np.abs(apart)),
                     other_apart, apart)
    off = (apart > APART_NS) | (apart < -APART_NS) | ~start & (apart < -_OVERTAKEN_NS)
    return np.where(off, mark.stamp - expected, 0)


def _increasing(times: np.ndarray) -> np.ndarray:
    """Return times, each at least a nanosecond after the one before."""
    count = np.arange(len(times))
    return np.maximum.accumulate(times - count) + count
