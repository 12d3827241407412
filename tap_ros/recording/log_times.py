# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Correct log times: the recorder's clock may be set, stand still, or be wrong for a moment."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from tap_ros.messages.stamps import PROOF
from tap_ros.recording.columns import Track
from tap_ros.recording.jumps import level_change, set_places, without_bogus

NOMINAL_NS = 10**8  # between frames of which neither stamps nor log times tell anything
_UNEVEN_NS = 15 * 10**8  # a topic may be written so much later than others
_FEW, _RARE = 3, 0.05  # messages of a topic, or the share of them, that are wrong by themselves
_NEAR = 20  # messages around a place where another topic saw that the clock was set
_AROUND = 9  # messages that tell whether stamps were set, too
_STREAMS = ('frame', 'twist', 'joint', 'arm', 'object')


def one_log(tracks: dict[str, Track], said: list[str]) -> dict[str, Track]:
    """
    Return messages whose log times, and stamps that were set with them, go on where they were set.

    :param tracks: by name, in the order in which they were written.
    :param said: warnings are appended to it.
    """
    tracks = _moving_log(tracks, said)
    found: list[int] = []
    _one_by_one(tracks, said)
    for name in sorted(_STREAMS, key=lambda name: -len(tracks[name])):  # the densest sees it best
        for i, amount in reversed(set_places(tracks[name].log)):
            before, place = tracks[name].order[i - 1:i + 1].tolist()
            if any(_went_on(track, before, place, amount) and not _moved_along(
                    track, tracks[name], place, amount) for track in tracks.values()):
                continue
            place = _first_behind(tracks, (before, place), int(tracks[name].log[i - 1]), amount)
            free = [change for track in tracks.values() if not _followed(track, place, amount)
                    and (change := _offset_change(track, place)) is not None]
            amount = -int(np.median(free)) if free else amount
            found.append(amount)
            tracks = {key: _set(track, place, amount) for key, track in tracks.items()}
    if found:
        said.append('the clock of the recorder ' + how_set(found))
    return tracks


def how_set(jumps: Sequence[int]) -> str:
    """Put in words how often a clock was set, and by how much."""
    words = []
    for way, sizes in (('back', [-a for a in jumps if a < 0]),
                       ('forward', [a for a in jumps if a > 0])):
        if sizes:
            often = f' {len(sizes)} times, by up to' if len(sizes) > 1 else ' by'
            words.append(f'set {way}{often} {max(sizes) / 1e9:.2f} s')
    return f'was {" and ".join(words)}; messages go on in the order in which they were written'


def _moving_log(tracks: dict[str, Track], said: list[str]) -> dict[str, Track]:
    """Replace log times that stand still by stamps, or else by ten pictures a second."""
    frame = tracks['frame']
    if len(frame) <= PROOF or (np.diff(frame.log) == 0).mean() <= 0.5:
        return tracks
    moves = (np.diff(frame.stamp) > 0).all()
    times = frame.stamp if moves else np.arange(len(frame)) * NOMINAL_NS
    said.append('log times stand still; ' + (
        'stamps take their place' if moves else 'messages are read in the order of writing'))
    return {name: replace(track, log=np.interp(
        track.order, frame.order, times - times[0]).astype(np.int64) + times[0])
        for name, track in tracks.items()}


def _one_by_one(tracks: dict[str, Track], said: list[str]) -> None:
    """Replace single log times that are far from all around, in their topic or in the file."""
    order = np.argsort(np.concatenate([track.order for track in tracks.values()]))
    logs = np.concatenate([track.log for track in tracks.values()])
    logs[order] = without_bogus(logs[order], _UNEVEN_NS)
    edges = np.cumsum([len(track) for track in tracks.values()])
    wrong = 0
    for (name, track), every in zip(list(tracks.items()), np.split(logs, edges[:-1])):
        if np.count_nonzero(every != track.log) > max(_FEW, len(track) * _RARE):
            every = track.log  # all of this topic is written later than others
        log = without_bogus(every)
        count = int((log != track.log).sum())
        if count:
            wrong += count
            tracks[name] = replace(track, log=log)
    if wrong:
        said.append(f'{wrong} of {len(logs)} log times cannot be right; those messages stay in '
                    'the order in which they were written')


def _place(track: Track, times: np.ndarray, place: int, amount: int) -> int:
    """Return the first message that a clock stamped after it was set, near a place in the log."""
    i = int(np.searchsorted(track.order, place))
    first = max(i - _NEAR, 0)
    steps = np.diff(times[first:i + _NEAR])
    if not len(steps):
        return i
    unlike = np.abs(steps - np.median(steps) - amount)
    own = int(np.argmin(unlike))
    jumps = steps[own] < 0 if amount < 0 else steps[own] > amount / 2
    return first + own + 1 if jumps and unlike[own] < abs(amount) / 2 else i


def _went_on(track: Track, before: int, place: int, amount: int) -> bool:
    """Tell whether a topic's log times pass a place in small steps, as if no clock was set."""
    first, i = np.searchsorted(track.order, (before, place)).tolist()
    if not 1 < first <= i < len(track) - 1:
        return False
    steps = np.diff(track.log[max(i - _NEAR, 0):i + _NEAR]) * np.sign(amount)
    usual = np.median(np.abs(steps))
    pause = np.diff(track.log[first - 1:i + 1]).max() - usual
    return bool(pause < abs(amount) / 2 > usual and (
        steps - usual * np.sign(amount)).max() < abs(amount) / 2)


def _moved_along(track: Track, dense: Track, place: int, amount: int) -> bool:
    """
    Tell whether log times of two topics were set together, by what is written near each other.

    Where the clock was set in a pause of a camera, its own log times show no more than a shorter
    or a longer pause.
    """
    i = int(np.searchsorted(track.order, place))
    beside = np.searchsorted(dense.order, track.order[max(i - _NEAR, 0):i + _NEAR])
    apart = track.log[max(i - _NEAR, 0):i + _NEAR] - dense.log[np.minimum(beside, len(dense) - 1)]
    before, after = np.split(apart, [min(i, _NEAR)])
    return bool(abs(np.median(after) - np.median(before)) < abs(amount) / 2)


def _first_behind(tracks: dict[str, Track], between: tuple[int, int], log: int,
                  amount: int) -> int:
    """
    Return the place of the first message of any topic that was logged after a clock was set.

    :param between: places of the messages of one topic before and behind it.
    :param log: log time of that before it.
    """
    first = between[1]
    for track in tracks.values():
        rows = slice(*np.searchsorted(track.order, between, 'right'))
        moved = (track.log[rows] - log) * np.sign(amount) > abs(amount) / 2
        first = min([first, *track.order[rows][moved].tolist()])
    return first


def _offset_change(track: Track, place: int) -> float | None:
    """Return by how much stamps go ahead of log times at a place; None if nothing tells."""
    rows = np.flatnonzero(track.stamp != 0)
    i = int(np.searchsorted(track.order[rows], place))
    if not 0 < i < len(rows):
        return None
    near = rows[max(i - _AROUND, 0):i + _AROUND] if len(rows) > 4 * PROOF else rows[i - 1:i + 1]
    return level_change((track.stamp - track.log)[near], int(np.searchsorted(near, rows[i])))[0]


def _followed(track: Track, place: int, amount: int) -> bool:
    """Tell whether stamps were set together with log times, as far as one can see."""
    change = _offset_change(track, place)
    return change is None or abs(change) < abs(amount) / 2 or change * amount > 0


def _set(track: Track, place: int, amount: int) -> Track:
    """Return messages whose clock was not set by an amount at a place."""
    if not len(track):
        return track
    rows = np.arange(len(track))
    log = np.where(rows >= _place(track, track.log, place, amount), track.log - amount, track.log)
    if not _followed(track, place, amount):
        return replace(track, log=log)
    behind = (rows >= _place(track, track.stamp, place, amount)) & (track.stamp != 0)
    return replace(track, log=log, stamp=np.where(behind, track.stamp - amount, track.stamp))
