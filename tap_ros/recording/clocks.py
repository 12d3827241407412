# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Correct stamps and log times of recorded messages where they are wrong.

Only the order in which messages were written is always right. Log times come from one clock, the
recorder's; where that was set, what was logged before is moved. Stamps come from the clock of each
topic's driver. Where those of a topic jump, stand still or are of another clock than the camera's,
its times are taken from the log; where the camera's do, those of every topic are. Every message is
kept, each correction gives a warning that names the topic, and times that are right stay.
"""

from dataclasses import replace
import warnings

import numpy as np
from tap_ros.base.text import escaped
from tap_ros.messages.stamps import PROOF
from tap_ros.recording.columns import Track
from tap_ros.recording.episode import RecordingWarning

NOMINAL_NS = 10**8  # between frames of which neither stamps nor log times tell anything
_APART_NS = 7 * 10**8  # late messages and slow cameras explain no larger difference of two clocks
_BEHIND_NS = 35 * 10**7  # only a camera is late; what else is behind it has another clock
_SET_NS = 10**8  # a clock that is set back by less is not told from jitter
_YEARS_NS = 30 * 86400 * 10**9  # nobody records so long a pause: the clock got the time
_BOGUS_NS = 5 * 10**8  # a single time is wrong by more
_EDGE_NS = 5 * 10**9  # likewise one of the first or the last: they may be late, or old
_PAUSE_NS = 5 * 10**8  # of a camera, in which its clock may be set back unseen
_OVERTAKEN_NS = 10**8  # a frame may be logged so long before the mark that precedes it
_ANSWER_NS = 5 * 10**9  # what is about a picture may be logged so much later
_FEW, _LONG = 3, 30  # messages beside a place that are too few, or enough, to tell what it is
_MANY = 10  # messages of one stamp, of which no driver sends so many together
_SMOOTH = 9  # messages that tell how far two clocks are apart
_STREAMS = ('frame', 'twist', 'joint', 'arm', 'object')
_OF_ANOTHER = 'are of another clock than the camera, which is ahead or behind'


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
    tracks = _one_log(dict(tracks), said)
    frame, mark = _without_resent(tracks['frame']), tracks['mark']
    tracks['frame'] = frame
    if not frame.stamp.any():
        tracks |= _all_by_log(tracks)
    elif len(same := np.flatnonzero(np.diff(frame.stamp) == 0)) or _jumps(frame, mark, gaps, True):
        if not said:  # else it is the same cause
            said.append(
                f'{called["frame"]}: of {len(frame)} stamps {len(same)} are repeated, '
                f'{np.count_nonzero(frame.stamp == 0)} are zero and '
                f'{np.count_nonzero(np.diff(frame.stamp) < 0)} go back, or its clock was set; log '
                'times take their place, for all topics')
        tracks |= _all_by_log(tracks)
    else:
        found = {name: _stamped(name, tracks, gaps) for name in (*_STREAMS[1:], 'mark')
                 if len(tracks[name])}
        for name, (track, why) in found.items():
            tracks[name] = track
            if why:
                said.append(f'{called[name]}: its {len(track)} stamps {why}; log times take their '
                            'place')
        if found and all(why for _, why in found.values()):  # the camera's clock is the odd one
            for name in ('goal', 'goal_mask', 'goal_object'):
                track, ahead = tracks[name], int(np.median(frame.stamp - frame.log))
                tracks[name] = replace(
                    track, stamp=np.where(track.stamp == 0, 0, track.stamp + ahead))
    for text in dict.fromkeys(said):
        warnings.warn(f'{escaped(source)}: {text}', RecordingWarning, stacklevel=3)
    return {name: _sorted(track) for name, track in tracks.items()}


def _sorted(track: Track) -> Track:
    """Return messages sorted by log time."""
    return track.take(np.argsort(track.log, kind='stable'))


def _one_log(tracks: dict[str, Track], said: list[str]) -> dict[str, Track]:
    """Return messages whose log times go on where the clock of the recorder was set."""
    tracks, wrong, found = _moving_log(tracks, said), 0, []
    for name in _STREAMS:
        log, single = _without_single(tracks[name].log)
        tracks[name], wrong = replace(tracks[name], log=log), wrong + single
    if wrong:
        said.append(f'{wrong} of its log times cannot be right; those messages stay in the order '
                    'in which they were written')
    for name in sorted(_STREAMS, key=lambda name: -len(tracks[name])):  # the densest sees it best
        steps = np.diff(tracks[name].log)
        for i in (np.flatnonzero((steps < -_SET_NS) | (steps > _YEARS_NS)) + 1).tolist():
            change = int(steps[i - 1] - np.median(steps))
            place = _first_behind(tracks, tracks[name], i, change)
            found.append(change)
            tracks = {key: replace(track, log=np.where(
                track.order < place, track.log + change, track.log))
                for key, track in tracks.items()}
    if found:
        most = max(found, key=abs)
        often = f'{len(found)} times, by up to' if len(found) > 1 else 'by'
        said.append(f'the clock of the recorder was set {"back" if most < 0 else "forward"} '
                    f'{often} {abs(most) / 1e9:.1f} s; messages go on in the order in which they '
                    'were written')
    return tracks


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


def _without_single(log: np.ndarray) -> tuple[np.ndarray, int]:
    """Put single times (N,) that are far from those around between them; return their number."""
    if len(log) <= 2 * _FEW:
        return log, 0
    before, after, own = log[:-2], log[2:], log[1:-1]
    wrong = (before <= after) & (np.abs(own - np.clip(own, before, after)) > _BOGUS_NS)
    between = np.where(wrong, before + (after - before) // 2, own)
    return np.concatenate([log[:1], between, log[-1:]]), int(wrong.sum())


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
    """Return what is about pictures with the stamps that these have now."""
    if not len(track) or not len(after):
        return track
    order = np.lexsort((after.order, before.stamp))
    stamps, places = before.stamp[order], after.order[order]
    first, last = (np.searchsorted(stamps, track.stamp, side) for side in ('left', 'right'))
    # Of pictures of one stamp that which was written last before it, or else the first.
    keys = np.lexsort((np.append(places, track.order), np.append(stamps, track.stamp)))
    rank = np.empty(len(keys), np.int64)
    rank[keys] = np.cumsum(keys < len(stamps))
    found = order[np.clip(rank[len(stamps):] - 1, first, np.maximum(last - 1, first)).clip(
        max=len(order) - 1)]
    later = track.log - after.log[found]
    known = (last > first) & (later < _ANSWER_NS) & (later > -_OVERTAKEN_NS)
    return replace(track, stamp=np.where(known, after.stamp[found], track.log))


def _stamped(name: str, tracks: dict[str, Track], gaps: np.ndarray) -> tuple[Track, str]:
    """Return what has stamps that can be compared with those of frames, and what was wrong."""
    track, frame = tracks[name], tracks['frame']
    shown = _sorted(frame)
    newest = np.maximum(np.searchsorted(shown.log, track.log, 'right') - 1, 0)
    by_log = track.log + (shown.stamp - shown.log)[newest]
    zero = track.stamp == 0
    if name == 'mark':
        off = ~zero & (np.abs(_away(track, frame)[0]) > _APART_NS)
        return (replace(track, stamp=np.where(zero, 0, by_log)), _OF_ANOTHER) if off.any() else (
            track, '')
    repeats = _repeats(track, name)
    if zero.any():  # a command answers a frame
        track = replace(track, stamp=np.where(
            zero, by_log if name in ('joint', 'arm') else shown.stamp[newest], track.stamp))
    why = 'are repeated' if repeats else (
        'go back' if _jumps(track, tracks['mark'], gaps, False) else
        _OF_ANOTHER if _is_apart(track, frame) else '')
    return replace(track, stamp=by_log) if why else track, why


def _repeats(track: Track, name: str) -> bool:
    """Tell whether stamps stand still while values change."""
    if name == 'object' or len(track) <= PROOF:
        return False
    values = track.picked()
    same = (np.diff(track.stamp) == 0) & (track.stamp[1:] != 0)
    differ = same & ~np.isclose(values[1:], values[:-1], equal_nan=True).all(1)
    counts = np.bincount(np.cumsum(~same), differ)  # how often values change within one stamp
    return bool(differ.mean() > 0.5 or counts.max() > _MANY)


def _jumps(track: Track, mark: Track, gaps: np.ndarray, camera: bool) -> bool:
    """
    Tell whether the clock of a topic was set, other than where an episode begins.

    :param camera: one that is set ahead, or back in a pause, shows by its log times alone; other
        topics are compared with it.
    """
    stamp, steps = track.stamp, np.diff(track.stamp)
    places = np.flatnonzero(steps < 0) + 1
    moved = _moved(track) if camera and len(steps) else places[:0]
    if not len(places) and not len(moved):
        return False
    if (~_anew(track, moved, mark, gaps)).any():
        return True
    period = float(np.median(steps))
    for part in np.split(stamp, places[_anew(track, places, mark, gaps)]):
        late = np.maximum.accumulate(part) - part
        turns = np.flatnonzero(np.diff(late > 0, prepend=False, append=False))
        if len(turns):
            most = np.maximum.reduceat(np.append(late, 0), turns)[::2]
            begins, ends = turns[::2], turns[1::2]
            together = (ends - begins > 1) | camera & (ends == len(part))  # not only overtaken
            if (together & (most > max(_SET_NS, period / 2))).any() or camera and (
                    most > max(_BOGUS_NS, 3 * period)).any():
                return True
    return False


def _moved(track: Track) -> np.ndarray:
    """Return the rows from which on stamps are ahead of log times, or in a pause fall behind."""
    steps, offset = np.diff(track.stamp), track.stamp - track.log
    moves = np.diff(offset)
    usual = np.flatnonzero((moves < _APART_NS) & (steps > 0))
    usual = usual[np.argsort(moves[usual])[_FEW:]]
    passed, logged = steps[usual].sum(), (steps - moves)[usual].sum()
    if abs(passed - logged) > 0.1 * passed + _APART_NS:  # as in a simulation
        return usual[:0]
    found = []
    for i in (np.flatnonzero(np.abs(moves) > _APART_NS) + 1).tolist():
        before, after = offset[max(i - _LONG, 0):i], offset[i:i + _LONG]
        least = _APART_NS if min(len(before), len(after)) > _FEW else _EDGE_NS
        ahead, behind = after.min() - before.max(), before.min() - after.max()
        paused = steps[i - 1] > max(_PAUSE_NS, 4 * np.median(steps))
        if ahead > least or paused and (
                behind > max(least, 2 * np.ptp(before), 2 * np.ptp(after))):
            found.append(i)
    return np.array(found, int)


def _anew(track: Track, rows: np.ndarray, mark: Track, gaps: np.ndarray) -> np.ndarray:
    """
    Tell before which rows (N,) a clock begins anew as that of a simulation that is reset.

    There the stamps of the marks around jump alike; or marks may be lost.
    """
    if not len(mark) or not len(rows):
        return np.zeros(len(rows), bool)
    stamp, log = track.stamp, track.log
    first = np.searchsorted(mark.order, track.order[rows - 1], 'right')
    last = np.searchsorted(mark.order, track.order[rows]) - 1
    started = np.maximum(first - 1, 0)
    between = (last >= first) | (first == 0) | (mark.index[started] != 0) | (
        np.abs(log[rows] - mark.log[started]) < _OVERTAKEN_NS)
    between |= ((gaps[:, :1] <= log[rows]) & (gaps[:, 1:] >= log[rows - 1])).any(0)
    agrees = np.zeros(len(rows), bool)
    for k in (np.maximum(last, 0), np.minimum(last + 1, len(mark) - 1)):
        new, old = (np.abs(mark.stamp[k] - np.clip(mark.stamp[k], *np.sort(
            [stamp[i], stamp[i] + mark.log[k] - log[i]], 0))) for i in (rows, rows - 1))
        agrees |= (new < _APART_NS) & (new <= old)
    return between & (agrees if mark.stamp.any() else last >= first)


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
    """Tell whether stamps are of another clock than the camera's, for a while at least."""
    apart, inside = _away(track, frame)
    if len(inside) <= PROOF or np.isin(track.stamp[inside], frame.stamp).mean() > 0.5:
        return False  # what repeats stamps of frames is of the camera's clock, however late
    base = apart[inside]
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(
        base, min(_SMOOTH, len(base))), 1)
    return bool(((smooth > _APART_NS) | (smooth < -_BEHIND_NS)).any())
