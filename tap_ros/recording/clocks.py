# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Times of recorded messages, put right where they cannot be what they claim to be.

Stamps of some drivers repeat, are whole seconds, zero or frozen; clocks are set back while they
are recorded; a camera counts since it was switched on. Whatever it is, each message is kept, in
the order in which it was written, and somebody is told.
"""

from dataclasses import replace
import warnings

import numpy as np
from tap_ros.messages.stamps import PROOF
from tap_ros.recording.columns import Track
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.spans import MAX_JITTER_NS
from tap_ros.text import escaped

APART_NS = 5 * 10**9  # topics farther apart than this have clocks of their own
SMALLEST_NS = 20 * 10**6  # a clock that is set back by less is not told from jitter
NOMINAL_NS = 10**8  # between frames of which neither stamps nor log times tell anything
_OFTEN_NS = 10 * 10**9  # no clock is set back so often
AHEAD_NS = 3600 * 10**9  # a clock that jumps by more was set, and did not wait
_AROUND = 9  # messages before and after a place that are compared
_STREAMS = ('frame', 'twist', 'joint', 'arm', 'object')


def put_right(tracks: dict[str, Track], source: str, topics: dict[str, str]) -> dict[str, Track]:
    """
    Return the messages of all names, sorted by log time.

    :param tracks: by name, in the order in which they were written; stamps 0 where there are none.
    :param source: what warnings call the recording.
    :param topics: by name; likewise.
    """
    said: list[str] = []
    called = {name: f'topic {escaped(topics.get(name, name))}' for name in tracks}
    called['arm'] = called['joint']
    tracks = _one_log(_moving_log(tracks, said), said)
    tracks = {name: track.take(np.argsort(track.log, kind='stable'))
              for name, track in tracks.items()}
    before = tracks['frame']
    tracks['frame'] = frame = _frames(tracks, called['frame'], said)
    for name in _STREAMS[1:]:
        tracks[name] = _stamped(tracks[name], tracks, called[name], said)
    if frame.stamp is not before.stamp:
        tracks['mask'] = _restamped(tracks['mask'], before, frame)
    _one_clock(tracks, called, said)
    for text in dict.fromkeys(said):
        warnings.warn(f'{escaped(source)}: {text}', RecordingWarning, stacklevel=3)
    return tracks


def _set_back(times: np.ndarray, least: int) -> np.ndarray:
    """Return where times (N,) in the order of writing go back by more than `least`, for good."""
    newest = np.maximum.accumulate(times)
    back = np.flatnonzero(times[1:] < times[:-1] - least) + 1
    proofs = ((i, times[i:i + PROOF]) for i in back.tolist() if len(times) >= i + PROOF)
    return np.array([i for i, proof in proofs if (proof < newest[i - 1] - MAX_JITTER_NS).all() or (
        (proof < newest[i - 1]).all() and (np.diff(proof) >= 0).all())], np.int64)


def _moving_log(tracks: dict[str, Track], said: list[str]) -> dict[str, Track]:
    """Let log times that stand still go on as stamps do, or as pictures were written."""
    frame = tracks['frame']
    if len(frame) <= PROOF or (np.diff(frame.log) == 0).mean() <= 0.5:
        return tracks
    moves = (np.diff(frame.stamp) > 0).all()
    times = frame.stamp if moves else np.arange(len(frame)) * NOMINAL_NS
    said.append(f'log times stand still; {"stamps" if moves else "the order of writing"} counts')
    return {name: replace(track, log=np.interp(
        track.order, frame.order, times - times[0]).astype(np.int64) + times[0])
        for name, track in tracks.items()}


def _one_log(tracks: dict[str, Track], said: list[str]) -> dict[str, Track]:
    """Let log times, and stamps that went back with them, go on where the clock was set back."""
    found = []  # (place of the first message behind, of the last one before, ns)
    for track in (tracks[name] for name in _STREAMS):
        both = np.intersect1d(_set_back(track.log, SMALLEST_NS),
                              _set_back(track.stamp, SMALLEST_NS))
        for i in np.union1d(_set_back(track.log, MAX_JITTER_NS), both).tolist():
            step = np.diff(track.log[max(i - _AROUND, 0):i])
            found.append((int(track.order[i]), int(track.order[i - 1]), int(
                track.log[i - 1] - track.log[i] + (np.median(step) if len(step) else 1))))
    end, changes = -1, 0
    for place, last, amount in sorted(found):
        if last < end:  # another topic at the same time
            continue
        end, changes = place, changes + 1
        shared = _went_back(tracks['frame'], place, amount, True)
        for name, track in tracks.items():
            behind = track.order >= place
            moved = _went_back(track, place, amount, shared) & (track.stamp != 0)
            tracks[name] = replace(
                track, log=np.where(behind, track.log + amount, track.log),
                stamp=np.where(behind & moved, track.stamp + amount, track.stamp))
        said.append(f'the clock was set back by {amount / 1e9:.2f} s; what was written after goes '
                    'on from there')
    return tracks


def _went_back(track: Track, place: int, amount: int, otherwise: bool) -> bool:
    """Tell whether stamps went back together with log times."""
    offset, behind = track.stamp - track.log, track.order >= place
    stamped = track.stamp != 0
    before, after = offset[~behind & stamped][-_AROUND:], offset[behind & stamped][:_AROUND]
    if not len(before) or not len(after):
        return otherwise
    return bool(np.median(after) - np.median(before) < amount / 2)


def _frames(tracks: dict[str, Track], called: str, said: list[str]) -> Track:
    """Return the frames, those sent again left out, with stamps that increase."""
    frame = tracks['frame']
    if len(frame) < 2:
        return frame
    written = frame.take(np.argsort(frame.order))
    same = np.diff(written.stamp) == 0
    again = same & (np.diff(written.picked()[:, 0]) == 0) & (written.stamp[1:] != 0)
    by_log = replace(written, stamp=_increasing(written.log)).take(
        np.argsort(written.log, kind='stable'))
    if not frame.stamp.any():  # it has none
        return by_log
    # A clock that begins at zero agrees with the next stamp.
    jumps = np.abs(np.diff(written.stamp - written.log, append=written.stamp[-1])) > APART_NS
    repeated, unstamped = int((same & ~again).sum()), int((jumps & (written.stamp == 0)).sum())
    back = 0 if len(tracks['mark']) else int((np.diff(written.stamp) < -MAX_JITTER_NS).sum())
    often = back >= PROOF and back * _OFTEN_NS > np.ptp(frame.log)
    if repeated or unstamped or often:
        said.append(f'{called}: of {len(frame)} stamps {repeated} are repeated, {unstamped} are '
                    f'zero and {back} go back; its pictures are put in order by log time')
        return by_log
    kept = written.take(np.flatnonzero(~np.append(False, again)))
    kept = replace(kept, stamp=_going_on(kept, tracks['mark'], called, said))
    if kept.stamp is written.stamp and not again.any():
        return frame
    return kept.take(np.argsort(kept.log, kind='stable'))


def _stamped(track: Track, tracks: dict[str, Track], called: str, said: list[str]) -> Track:
    """Return states or commands with stamps that can be compared with those of frames."""
    frame = tracks['frame']
    if not len(frame) or not len(track):
        return track
    newest = np.maximum(np.searchsorted(frame.log, track.log, 'right') - 1, 0)
    by_log = track.log + (frame.stamp - frame.log)[newest]
    repeats = (np.diff(track.stamp) == 0) & (track.stamp[1:] != 0)
    if len(track) > PROOF and track is not tracks['object'] and repeats.mean() > 0.5:
        values = track.picked()
        differ = repeats & ~np.isclose(values[1:], values[:-1], equal_nan=True).all(1)
        if differ.mean() > 0.5:  # they are not the same ones, sent again
            said.append(f'{called}: {int(repeats.sum())} of {len(track)} stamps are repeated; log '
                        'times are taken')
            return replace(track, stamp=by_log)
    state = track is tracks['joint'] or track is tracks['arm']  # a command answers a frame
    track = replace(track, stamp=np.where(
        track.stamp == 0, by_log if state else frame.stamp[newest], track.stamp))
    written = track.take(np.argsort(track.order))
    stamp = _going_on(written, tracks['mark'], called, said)
    return track if stamp is written.stamp else replace(written, stamp=stamp).take(
        np.argsort(written.log, kind='stable'))


def _going_on(track: Track, mark: Track, called: str, said: list[str]) -> np.ndarray:
    """
    Return stamps (N,) that go on where their clock alone was set back.

    A clock that begins anew, at a mark or from its first stamp, counts another episode.

    :param track: in the order of writing.
    """
    stamp, begin, offsets = track.stamp, 0, []
    steps = np.diff(stamp)
    for i in (np.flatnonzero((steps < -SMALLEST_NS) | (
            steps - np.diff(track.log) > AHEAD_NS)) + 1).tolist():
        back = int(stamp[i - 1] - stamp[i])
        behind, before = (np.median((stamp - track.log)[part]) for part in (
            slice(i, i + _AROUND), slice(max(i - _AROUND, begin), i)))
        marked = ((mark.order > track.order[i - 1]) & (mark.order < track.order[i])).any()
        if back > 0 and marked or (stamp[i] <= stamp[begin:i].min() and back > MAX_JITTER_NS):
            begin = i
        elif back < 0 or behind - before < -back / 2:
            step = max(int(track.log[i] - track.log[i - 1]), 1)
            offsets.append((i, back + step))
    if offsets:
        stamp = stamp.copy()
        for i, offset in offsets:
            stamp[i:] += offset
        said.append(f'{called}: its clock was set {len(offsets)} times, back by up to '
                    f'{max(offset for _, offset in offsets) / 1e9:.2f} s; its messages stay in '
                    'the order in which they were written')
    return stamp


def _restamped(mask: Track, before: Track, after: Track) -> Track:
    """Return masks with the stamps that their pictures have now."""
    new = dict(zip(before.order.tolist(), before.stamp.tolist()))
    old = np.array([new[order] for order in after.order.tolist()], np.int64)
    order = np.argsort(old, kind='stable')
    place = np.minimum(np.searchsorted(old[order], mask.stamp), max(len(old) - 1, 0))
    if not len(old) or not len(mask):
        return mask
    found = order[place]
    return replace(mask, stamp=np.where(old[found] == mask.stamp, after.stamp[found], mask.stamp))


def _one_clock(tracks: dict[str, Track], called: dict[str, str], said: list[str]) -> None:
    """Bring the stamps of topics to the clock of the camera, by log time, where it is another."""
    frame, shifts = tracks['frame'], {}
    for name in (*_STREAMS[1:], 'mark'):
        track = tracks[name]
        stamped = track.stamp != 0
        if len(frame) and stamped.any():
            shifts[name] = int(np.median(_apart(track, frame)[stamped]))
    moved = {name: shift for name, shift in shifts.items() if abs(shift) > APART_NS}
    for name, shift in moved.items():
        tracks[name] = _shifted(tracks[name], shift)
        said.append(f'{called[name]}: its clock and that of the camera are {abs(shift) / 1e9:.1f} '
                    's apart; they are brought together by log time')
    if moved and len(moved) == len(shifts):  # the camera's is the odd one
        for name in ('goal', 'goal_mask', 'goal_object'):
            tracks[name] = _shifted(tracks[name], sorted(moved.values())[len(moved) // 2])


def _apart(track: Track, frame: Track) -> np.ndarray:
    """Return (N,) how far the clock of each message is behind that of the frame logged nearest."""
    after = np.minimum(np.searchsorted(frame.log, track.log), len(frame) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(frame.log[after] - track.log) <= np.abs(
        frame.log[before] - track.log), after, before)
    return (track.log - track.stamp) - (frame.log - frame.stamp)[nearest]


def _shifted(track: Track, shift: int) -> Track:
    """Return messages with other stamps; none stays none."""
    return replace(track, stamp=np.where(track.stamp == 0, 0, track.stamp + shift))


def _increasing(times: np.ndarray) -> np.ndarray:
    """Return times, each at least a nanosecond after the one before."""
    count = np.arange(len(times))
    return np.maximum.accumulate(times - count) + count
