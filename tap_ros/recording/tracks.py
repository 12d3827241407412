# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The messages of the files of a bag as tracks, one a name, whose times can be compared.

Only the order in which messages were written is always right. Log times come from one clock, the
recorder's; where that was set, what was logged before is moved. Stamps come from the clock of each
topic's driver. Where those of a topic go back, stand still or are of another clock than the
camera's, its times are taken from the log; where the camera's do, those of every topic are. Every
message is kept, each correction gives a warning that names the topic, and right times stay.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import warnings

import numpy as np
from tap_ros.base.errors import RecordingWarning
from tap_ros.base.text import escaped
from tap_ros.messages.stamps import PROOF
from tap_ros.recording.columns import Columns, Mark, NAMED, NAMES, Track, WIDTHS
from tap_ros.recording.defects import FAR
from tap_ros.recording.reading import Reading
from tap_ros.recording.spans import find_rounds, read_spans, Span

_APART_NS = 7 * 10**8  # late messages and slow cameras explain no larger difference of two clocks
_BEHIND_NS = 35 * 10**7  # only a camera is late; what else is behind it has another clock
_SET_NS = 10**8  # a clock that is set back by less is not told from jitter
_YEARS_NS = 30 * 86400 * 10**9  # nobody records so long a pause: the clock got the time
_BOGUS_NS = 5 * 10**8  # a single time is wrong by more
_PAUSE_NS = 5 * 10**8  # of a camera, in which its clock may be set back unseen
_OVERTAKEN_NS = 10**8  # a frame may be logged so long before the mark that precedes it
_LONG = 30  # messages beside a place that tell what it is
_SMOOTH = 9  # messages that tell how far two clocks are apart
_STREAMS = ('frame', 'twist', 'joint', 'arm', 'signal', 'object')


def read_tracks(parts: Sequence[Columns], reading: Reading) -> tuple[
        dict[str, Track], list[tuple[str, ...]], np.ndarray, list[Span]]:
    """
    Join files that follow each other, correct their times, and find the episodes.

    :param parts: list of Columns, in playing order.
    :param reading: Reading; it says where episodes are cut that no marks tell apart.
    :return: Tracks by name, sorted by log time; names of objects by number; gaps (G, 2) as
        defects.gaps; spans of the episodes.
    """
    tracks, names, marks = join(parts)
    gaps, twist, frame = _gaps(parts), tracks['twist'], tracks['frame']
    if twist.stamp.any():  # zero twists without a stamp say stop, and answer no frame
        tracks['twist'] = twist.take(np.flatnonzero((twist.stamp != 0) | twist.picked().any(1)))
    rounds = () if marks else frame.order[find_rounds(frame.picked()[:, 0])]
    tracks = correct_times(tracks, parts[0], gaps)
    return tracks, names, gaps, read_spans(
        tracks, marks, gaps, np.flatnonzero(np.isin(tracks['frame'].order, rounds)), reading,
        parts[0].source)


def _gaps(parts: Sequence[Columns]) -> np.ndarray:
    """Return the gaps of all files, (G, 2); one without a place is behind what came before."""
    gaps, newest = [np.empty((0, 2), np.int64)], -FAR
    for part in parts:
        own = part.arrays.get('gap', gaps[0])
        gaps.append(np.where(own[:, :1] <= -FAR, newest, own))
        newest = int(part.logs(NAMES).max(initial=newest))
    return np.concatenate(gaps)


def join(parts: Sequence[Columns]) -> tuple[dict[str, Track], list[tuple[str, ...]], list[Mark]]:
    """Put the columns of several files one behind the other; return names and marks, too."""
    numbers: dict[tuple[str, ...], int] = {}
    tracks = {}
    for part in parts:
        for names in part.names:
            numbers.setdefault(tuple(names), len(numbers))
    counts = np.array([len(names) - 1 for names in numbers], np.int64)
    for name in NAMES:
        rows, values = [np.empty((0, 5), np.int64)], [np.empty((0, WIDTHS.get(name, 1)))]
        for file, part in enumerate(parts):
            found = part.arrays.get(name, np.empty((0, 4), np.int64)).copy()
            found[:, 2] += file << 40  # later files are behind earlier ones
            if name in NAMED:
                local = np.array([numbers[tuple(n)] for n in part.names], np.int64)
                found[:, 3] = local[found[:, 3]]
            rows.append(np.insert(found, 4, file, axis=1))
            values.append(part.arrays.get(f'{name}_values', values[0]))
        log, stamp, order, index, owner = np.concatenate(rows).T
        lengths = counts[index] if name in NAMED else np.ones(len(log), np.int64)
        tracks[name] = Track(log, stamp, order, index, owner, np.cumsum(lengths) - lengths,
                             np.concatenate(values))
    return tracks, list(numbers), [mark for part in parts for mark in part.marks]


def correct_times(tracks: Mapping[str, Track], part: Columns,
                  gaps: np.ndarray) -> dict[str, Track]:
    """
    Return the messages of all names, sorted by log time.

    :param tracks: by name, in the order in which they were written; stamps 0 where there are none.
    :param part: of the first file, which warnings name.
    :param gaps: (G, 2) as defects.gaps: where marks may be lost.
    """
    said: list[str] = []
    tracks = _one_log(dict(tracks), said)
    frame, mark = _without_resent(tracks['frame']), tracks['mark']
    tracks['frame'] = frame
    same = np.count_nonzero(np.diff(frame.stamp) == 0)
    if not frame.stamp.any():
        tracks |= _all_by_log(tracks)
    elif same or _goes_back(frame, mark, gaps) or _was_set(frame, mark, gaps):
        if not said:  # else it is the same cause
            said.append(
                f'topic {escaped(part.topics.get("frame"))}: of {len(frame)} stamps {same} are '
                f'repeated, {np.count_nonzero(frame.stamp == 0)} are zero and '
                f'{np.count_nonzero(np.diff(frame.stamp) < 0)} go back, or its clock was set; log '
                'times take their place, for all topics')
        tracks |= _all_by_log(tracks)
    else:
        for name in ('twist', 'joint', 'arm', 'object', 'signal', 'mark'):
            tracks[name], is_apart = _comparable(name, tracks[name], frame)
            if is_apart:
                topic = part.topics.get('joint' if name == 'arm' else name)
                said.append(f'topic {escaped(topic)}: its {len(tracks[name])} stamps are of '
                            'another clock than the camera, or stand still; log times take their '
                            'place')
            if is_apart and name == 'mark':  # with which these would be compared
                tracks |= {goal: replace(tracks[goal], stamp=0 * tracks[goal].stamp)
                           for goal in ('goal', 'goal_mask', 'goal_object')}
    for text in dict.fromkeys(said):
        warnings.warn(f'{escaped(part.source)}: {text}', RecordingWarning, stacklevel=3)
    return {name: _sorted(track) for name, track in tracks.items()}


def _sorted(track: Track) -> Track:
    return track.take(np.argsort(track.log, kind='stable'))


def _one_log(tracks: dict[str, Track], said: list[str]) -> dict[str, Track]:
    """Return messages whose log times go on where the clock of the recorder was set."""
    found = []
    for name in sorted(_STREAMS, key=lambda name: -len(tracks[name])):  # the densest sees it best
        steps = np.diff(tracks[name].log)
        for i in (np.flatnonzero((steps < -_SET_NS) | (steps > _YEARS_NS)) + 1).tolist():
            change = int(steps[i - 1] - np.median(steps))
            place = _first_behind(tracks, tracks[name], i, change)
            found.append(change)
            tracks = {key: replace(track, log=track.log + change * (track.order < place))
                      for key, track in tracks.items()}
    if found:
        most = max(found, key=abs)
        said.append(f'the clock of the recorder was set {"back" if most < 0 else "forward"}, by '
                    f'up to {abs(most) / 1e9:.1f} s; messages go on in the order in which they '
                    'were written')
    return tracks


def _first_behind(tracks: dict[str, Track], track: Track, i: int, change: int) -> int:
    """Return the place of the first message of any topic behind that where a clock was set."""
    first = int(track.order[i])
    for one in tracks.values():
        rows = slice(*np.searchsorted(one.order, track.order[i - 1:i + 1], 'right'))
        moved = (one.log[rows] - track.log[i - 1]) * np.sign(change) > abs(change) / 2
        first = min([first, *one.order[rows][moved].tolist()])
    return first


def _without_resent(frame: Track) -> Track:
    """Leave out pictures that were sent again, where no other ones repeat a stamp."""
    same = np.append(False, (np.diff(frame.stamp) == 0) & (frame.stamp[1:] != 0))[:len(frame)]
    again = same & np.append(False, np.diff(frame.picked()[:, 0]) == 0)[:len(frame)]
    if again.any() and (same == again).all() and np.ptp(frame.stamp):
        return frame.take(np.flatnonzero(~again))
    return frame


def _all_by_log(tracks: dict[str, Track]) -> dict[str, Track]:
    """Return the messages of pictures, and of what belongs to them, with log times as stamps."""
    before, count = tracks['frame'], np.arange(len(tracks['frame']))
    frame = replace(before, stamp=np.maximum.accumulate(before.log - count) + count)
    found = {name: replace(tracks[name], stamp=tracks[name].log)
             for name in (*_STREAMS[1:-1], 'mark')}
    return found | {'frame': frame} | {
        name: _restamped(tracks[name], before, frame) for name in ('mask', 'object')}


def _restamped(track: Track, before: Track, after: Track) -> Track:
    """Return what is about pictures with the stamp that its own has now, if that is the newest."""
    if not len(track) or not len(after):
        return track
    newest = np.maximum(np.searchsorted(after.order, track.order) - 1, 0)
    return replace(track, stamp=np.where(
        before.stamp[newest] == track.stamp, after.stamp[newest], track.log))


def _comparable(name: str, track: Track, frame: Track) -> tuple[Track, bool]:
    """Return what has stamps that can be compared with those of frames; whether it had others."""
    if not len(track):
        return track, False
    shown, zero = _sorted(frame), track.stamp == 0
    newest = np.maximum(np.searchsorted(shown.log, track.log, 'right') - 1, 0)
    by_log = track.log + (shown.stamp - shown.log)[newest]
    if name == 'mark':
        is_apart = bool((~zero & (np.abs(_away(track, frame)[0]) > _APART_NS)).any())
        return replace(track, stamp=by_log * ~zero) if is_apart else track, is_apart
    if zero.any():  # a command answers a frame
        track = replace(track, stamp=np.where(
            zero, by_log if name in ('joint', 'arm', 'signal') else shown.stamp[newest],
            track.stamp))
    is_apart = _is_apart(track, frame)
    return replace(track, stamp=by_log) if is_apart else track, is_apart


def _goes_back(frame: Track, mark: Track, gaps: np.ndarray) -> bool:
    """Return whether stamps go back, other than where an episode begins, or one was overtaken."""
    steps = np.diff(frame.stamp)
    places = np.flatnonzero(steps < 0) + 1
    period = float(np.median(steps)) if len(places) else 0
    for part in np.split(frame.stamp, places[_between_episodes(frame, places, mark, gaps)]):
        late = np.maximum.accumulate(part) - part
        far = late > max(_SET_NS, period / 2)
        several = (far[1:] & (late[:-1] > 0)) | (far[:-1] & (late[1:] > 0))
        if several.any() or far[-1:].any() or (late > max(_BOGUS_NS, 3 * period)).any():
            return True
    return False


def _was_set(frame: Track, mark: Track, gaps: np.ndarray) -> bool:
    """Return whether the camera's clock was set forward, or back in a pause, by its log times."""
    steps, offset = np.diff(frame.stamp), frame.stamp - frame.log
    moves = np.diff(offset)
    if not len(moves) or np.median(np.abs(moves)) > np.median(steps) / 4:  # as in a simulation
        return False
    rows = np.flatnonzero(np.abs(moves) > _APART_NS) + 1
    for i in rows[~_between_episodes(frame, rows, mark, gaps)].tolist():
        before, after = offset[max(i - _LONG, 0):i], offset[i:i + _LONG]
        paused = steps[i - 1] > max(_PAUSE_NS, 4 * np.median(steps))
        if min(len(before), len(after)) >= PROOF and (
                after.min() - before.max() > _APART_NS or paused and before.min() - after.max() > (
                    max(_APART_NS, 2 * np.ptp(before), 2 * np.ptp(after)))):
            return True
    return False


def _between_episodes(track: Track, rows: np.ndarray, mark: Track,
                      gaps: np.ndarray) -> np.ndarray:
    """
    Tell before which rows (N,) an episode begins, where a simulation may be reset.

    As marks say; or marks may be lost there.
    """
    if not len(mark):
        return np.zeros(len(rows), bool)
    first = np.searchsorted(mark.order, track.order[rows - 1], 'right')
    newest = np.maximum(first - 1, 0)
    return ((mark.order[np.minimum(first, len(mark) - 1)] < track.order[rows]) & (
        first < len(mark)) | (first == 0) | (mark.index[newest] != 0)
        | (np.abs(track.log[rows] - mark.log[newest]) < _OVERTAKEN_NS)
        | ((gaps[:, :1] <= track.log[rows]) & (gaps[:, 1:] >= track.log[rows - 1])).any(0))


def _away(track: Track, frame: Track) -> tuple[np.ndarray, np.ndarray]:
    """
    Return how far (N,) ns stamps are from what those of the frames around allow.

    :return: that; and rows that are written between two frames whose stamps tell them well.
    """
    behind = np.searchsorted(frame.order, track.order)
    sides = np.maximum(behind - 1, 0), np.minimum(behind, len(frame) - 1)
    ends = [one for rows in sides for one in (
        frame.stamp[rows], frame.stamp[rows] + track.log - frame.log[rows])]
    low, high = np.min(ends, 0), np.max(ends, 0)
    near = high - low <= max(_APART_NS, 2 * np.median(np.diff(frame.stamp, append=0)))
    return track.stamp - np.clip(track.stamp, low, high), np.flatnonzero(
        (behind > 0) & (behind < len(frame)) & near)


def _is_apart(track: Track, frame: Track) -> bool:
    """Return whether stamps are of another clock than the camera's, for a while at least."""
    apart, inside = _away(track, frame)
    if len(inside) <= PROOF or np.isin(track.stamp[inside], frame.stamp).mean() > 0.5:
        return False  # what repeats stamps of frames is of the camera's clock, however late
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(
        apart[inside], min(_SMOOTH, len(inside))), 1)
    return bool(((smooth > _APART_NS) | (smooth < -_BEHIND_NS)).any())
