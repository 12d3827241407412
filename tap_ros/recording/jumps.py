# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Find where a clock jumped, from arrays of times in the order in which messages were written.

A clock is compared with the log, which shows pauses but may be late, and with the usual period of
the messages, which is steady but shows no pauses. A clock jumped where the median difference of a
few messages before a place and that of a few behind it are further apart than these scatter.
Messages that are late, or overtake each other, do not move the median.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

APART_NS = 7 * 10**8  # late messages and slow cameras explain no larger difference of two clocks
LEAST_NS = 20 * 10**6  # a clock that is set back by less is not told from jitter
YEARS_NS = 30 * 86400 * 10**9  # nobody records so long a pause: the clock got the time
_AROUND = 10  # messages on each side of a place that are compared
_LONG = 30  # messages before a place, of which the least late one counts
_FEW = 3  # messages in a row may be wrong; more of them are a clock that was set
_BOGUS_NS = 5 * 10**8  # a message is wrong by more
_EDGE_NS = 5 * 10**9  # likewise the first or the last ones: they may be late, or old
_OFTEN_NS = 10 * 10**9  # no clock is set so often, three times in a row
_PAUSE_NS = 5 * 10**8  # of a camera, in which its clock may be set back unseen
_SURE = 2.5  # times the spread of messages


@dataclass
class Settled:
    """Stamps of one topic that go on where their clock was set."""

    stamp: np.ndarray  # (N,) int64, ns
    jumps: list[int] = field(default_factory=list)  # ns that the clock was set forward, or back
    bogus: int = 0  # stamps that log times replaced


def windows(values: np.ndarray, size: int) -> np.ndarray:
    """Return the median of so many values around each, (N,) float64; as many at the ends."""
    size = min(size, len(values))
    if size < 2:
        return values.astype(float)
    base = values[0]
    found = np.median(np.lib.stride_tricks.sliding_window_view(values - base, size), 1) + base
    before = (size - 1) // 2
    return np.pad(found, (before, size - 1 - before), 'edge')


def set_places(times: np.ndarray) -> list[tuple[int, int]]:
    """
    Return [(place, ns)] where times (N,) that mostly increase were set, by their cadence alone.

    Back by anything, or forward by years; then they go on. A single one that is wrong is none.
    """
    steps = np.diff(times)
    if not len(steps):
        return []
    period = np.median(steps)
    least = max(LEAST_NS, 4 * np.quantile(np.abs(steps - period), 0.75))
    stands = np.append(False, steps[:-1] == 0) | np.append(steps[1:] == 0, False)
    rough = (steps <= 0) & (np.abs(steps - period) > least) & ~((steps == 0) & stands)
    found: list[tuple[int, int]] = []
    times = times.copy()
    places = np.flatnonzero(rough | (steps > YEARS_NS)) + 1
    for i in places.tolist():
        change, spread = _by_cadence(times, i, _end(places, steps, i, len(times)))
        if change > YEARS_NS / 2 or _is_back(times, i, change, spread):
            change = min(int(change), int(times[i] - times[i - 1] - period / 4))  # in order
            found.append((i, change))
            times[i:] -= change
    return found


def without_bogus(times: np.ndarray, least: int = _BOGUS_NS) -> np.ndarray:
    """
    Return times (N,) of which single ones far from all around stand between their neighbours.

    :param least: ns; they are so far away.
    """
    wrong = _bogus(times, times, least)
    wrong[:_FEW] = wrong[max(len(times) - _FEW, 0):] = False  # nothing tells on which side it is
    if not wrong.any():
        return times
    rows = np.flatnonzero(~wrong)
    return np.where(wrong, np.interp(np.arange(len(times)), rows, times[rows] - times[rows[0]])
                    .astype(np.int64) + times[rows[0]], times)


def level_change(values: np.ndarray, i: int, begin: int = 0,
                 end: int | None = None) -> tuple[float, float]:
    """Return (change, spread) of the level of values (N,) at place i, within begin and end."""
    before = values[max(i - _AROUND, begin):i]
    after = values[i:min(i + _AROUND, len(values) if end is None else end)]
    first = values[i - 1]
    low, high = np.median(before - first), np.median(after - first)
    spread = np.abs(np.concatenate([before - first - low, after - first - high])).mean()
    return float(high - low), 1.25 * float(spread)


def settle(stamp: np.ndarray, log: np.ndarray, valid: np.ndarray,
           anew: Callable[[np.ndarray, np.ndarray], np.ndarray],
           forward: bool = True) -> Settled | None:
    """
    Let stamps go on where their clock was set, and put log times where they are wrong.

    :param stamp, log: (N,) int64, ns, in the order of writing; log times do not go back for good.
    :param valid: (N,) bool: stamps that may be right.
    :param anew: called with (before, after), rows on both sides of places: where the clock may
        begin anew, as marks do.
    :param forward: a clock may also be set forward, which a camera that is compared with the log
        alone shows.
    :return: Settled; None where too few stamps are right to go by them.
    """
    rows = np.flatnonzero(valid)
    offset = stamp - log
    steps, moves = np.diff(stamp[rows]), np.diff(offset[rows])
    ahead = forward and _comparable(steps, moves)
    odd = (steps < 0) | ((moves > APART_NS) & ahead) | (
        ahead & _back_in_pause(stamp[rows], offset[rows]))
    out = Settled(stamp, bogus=len(stamp) - len(rows))
    if not odd.any() and not out.bogus:
        return out
    places = np.flatnonzero(odd) + 1
    begins = places[anew(rows[places - 1], rows[places])]
    shift, good = np.zeros(len(stamp), np.int64), valid.copy()
    for part in np.split(rows, begins):
        if len(part) > _FEW:
            wrong = _bogus(stamp[part], offset[part], edges=ahead)
            good[part[wrong]] = False
            kept = part[~wrong]
            moved, jumps = _jumps(stamp[kept], log[kept], ahead)
            shift[kept] = moved
            out.jumps += jumps
    out.bogus = int((~good).sum())
    often = len(out.jumps) >= _FEW and len(out.jumps) * _OFTEN_NS > np.ptp(log)
    if often or out.bogus > len(stamp) // 4 or len(out.jumps) > max(len(stamp) // 10, 1):
        return None
    if out.jumps or out.bogus:
        out.stamp = _filled(stamp + shift, log, good)
    return out


def _comparable(steps: np.ndarray, moves: np.ndarray) -> bool:
    """Tell whether log times pass as fast as stamps; those of a simulation may not."""
    usual = np.flatnonzero((moves < APART_NS) & (steps > 0))
    usual = usual[np.argsort(moves[usual])[_FEW:]]  # the clock of the log may be set, too
    passed, logged = steps[usual].sum(), (steps - moves)[usual].sum()
    return bool(abs(passed - logged) <= 0.1 * passed + APART_NS)


def _back_in_pause(stamp: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """
    Tell between which messages (N - 1,) a clock was set back by less than they pause.

    Stamps are behind the log from there on, and for longer than what waits to be written.

    :param stamp, offset: (N,) int64, ns: stamps and how far they are ahead of the log.
    """
    steps = np.diff(stamp)
    found = np.diff(offset) < -APART_NS
    if found.any():
        found &= steps > max(_PAUSE_NS, 4 * np.median(steps))
    for i in (np.flatnonzero(found) + 1).tolist():
        before, after = offset[max(i - _LONG, 0):i], offset[i:i + _LONG]
        change = int(after.max() - before.min())
        found[i - 1] = min(len(before), len(after)) > _FEW and change < -APART_NS and (
            max(np.ptp(before), np.ptp(after)) < -change / 2)
    return found


def _bogus(times: np.ndarray, values: np.ndarray, least: int = _BOGUS_NS,
           edges: bool = False) -> np.ndarray:
    """
    Tell which messages (N,) are out of order and alone: a few, far from all around.

    :param times: (N,) int64, ns, in the order of writing.
    :param values: (N,) likewise, of which those of messages near each other are alike.
    :param least: ns that make them unlike.
    :param edges: the first and the last ones need not be out of order.
    """
    far = np.abs(values - windows(values, 2 * _FEW + 1)) > least
    wrong = np.zeros(len(times), bool)
    if not far.any():
        return wrong
    least = max(least, 4 * int(np.median(np.abs(np.diff(values)))))
    turns = np.flatnonzero(np.diff(far, prepend=False, append=False))
    for begin, end in zip(turns[::2].tolist(), turns[1::2].tolist()):
        around = [values[i] for i in (begin - 1, end) if 0 <= i < len(values)]
        set_there = values is times and 0 < begin and end < len(times) and (
            times[begin - 1] > times[end])
        if not around or set_there:
            continue
        apart = np.min([np.abs(values[begin:end] - one) for one in around], 0)
        alone = apart > (_EDGE_NS if len(around) < 2 and edges else least)
        back = (np.diff(times[max(begin - 1, 0):end + 1]) < 0).any()
        if alone.sum() <= _FEW and (back or len(around) < 2 and edges):
            wrong[begin:end] = alone
    return wrong


def _jumps(stamp: np.ndarray, log: np.ndarray,
           ahead: bool) -> tuple[np.ndarray, list[int]]:
    """Return (shift, jumps): ns by which stamps (N,) go on, on the clock of the best piece."""
    steps, offset = np.diff(stamp), stamp - log
    moves = np.diff(offset)
    shift, found = np.zeros(len(stamp), np.int64), []
    if not len(steps):
        return shift, []
    period = np.median(steps)
    least = np.minimum(*(max(LEAST_NS, 4 * np.quantile(np.abs(one), 0.75)) for one in (
        steps - period, moves)))
    forward = (moves > APART_NS) & ahead
    rough = (steps <= 0) & (np.maximum(np.abs(steps - period), np.abs(moves)) > least)
    paused = _back_in_pause(stamp, offset) & ahead
    places = np.flatnonzero(forward | rough | paused) + 1
    stamp, offset = stamp.copy(), offset.copy()
    for i in places.tolist():
        end = _end(places, moves, i, len(stamp))
        change, spread = level_change(offset, i, 0, end)
        if forward[i - 1]:
            gain = offset[i:i + _AROUND][:end - i].min() - offset[max(i - _LONG, 0):i].max()
            jumped = gain > APART_NS
        elif paused[i - 1]:
            jumped = True
        else:
            steady, narrow = _by_cadence(stamp, i, end)
            if narrow < spread and abs(steady - change) < 4 * (spread + narrow):
                change, spread = steady, narrow
            jumped = _is_back(stamp, i, change, spread)
        if jumped:
            change = min(int(change), int(stamp[i] - stamp[i - 1] - period / 4))  # in order
            found.append((i, change))
            for one in (stamp, offset, shift):
                one[i:] -= change
    if found:  # the best one agrees with the log, as other topics do, or is the longest
        edges = np.array([0, *(i for i, _ in found), len(stamp)])
        apart = np.array([abs(np.median(one - shift_of)) for one, shift_of in zip(
            np.split(offset, edges[1:-1]), np.split(shift, edges[1:-1]))])
        best = np.argmin(apart) if apart.min() < APART_NS else np.argmax(np.diff(edges))
        shift -= shift[edges[best]]
    return shift, [change for _, change in found]


def _end(places: np.ndarray, steps: np.ndarray, i: int, count: int) -> int:
    """Return where the next of places (P,) is that may be as important as place i."""
    least = min(abs(int(steps[i - 1])) / 2, APART_NS / 4)
    later = places[(places > i) & (np.abs(steps[places - 1]) >= least)]
    return max(int(later[0]), min(i + _FEW, count)) if len(later) else count


def _by_cadence(times: np.ndarray, i: int, end: int) -> tuple[float, float]:
    """Return (change, spread) of times at place i as if messages came steadily, up to pauses."""
    first = max(i - 2 * _AROUND, 0)
    steps = np.diff(times[first:min(i + 2 * _AROUND, end)])
    period = np.median(steps)
    pauses = first + 1 + np.flatnonzero(steps > 4 * max(period, LEAST_NS))
    begin = max([i - _AROUND, first, *pauses[pauses < i].tolist()])
    end = min([i + _AROUND, end, *pauses[pauses > i].tolist()])
    part = times[begin:end] - times[i - 1]
    return level_change(part - period * np.arange(len(part)), i - begin)


def _is_back(times: np.ndarray, i: int, change: float, spread: float) -> bool:
    """Tell whether a clock was set back at place i, and no message was only overtaken there."""
    if change > -max(LEAST_NS, _SURE * spread):
        return False
    first = max(i - _AROUND, 0)
    around = times[first:i + _AROUND] - times[i]
    back = np.where(np.arange(len(around)) < i - first, around, around - change)
    period = np.median(np.abs(np.diff(around)))
    rough, rough_if_back = (  # pauses are in both
        np.minimum(np.abs(np.diff(np.sort(one)) - period), period).sum() for one in (around, back))
    clear = len(times) - i >= _FEW and spread < period / 8  # what is overtaken changes no level
    return bool(change < -_AROUND * period or clear or rough_if_back < rough - period / 2)


def _filled(stamp: np.ndarray, log: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Return stamps (N,), those that are not good from log times, between their neighbours."""
    rows, missing = np.flatnonzero(good), np.flatnonzero(~good)
    if not len(missing):
        return stamp
    level = windows((stamp - log)[rows], 2 * _FEW + 1).astype(np.int64)
    after = np.minimum(np.searchsorted(rows, missing), len(rows) - 1)
    before = np.maximum(np.searchsorted(rows, missing) - 1, 0)
    nearer = np.abs(log[rows[before]] - log[missing]) <= np.abs(log[rows[after]] - log[missing])
    found = log[missing] + level[np.where(nearer, before, after)]
    low, high = stamp[rows[before]], stamp[rows[after]]
    between = (low < high) & (rows[before] < missing) & (missing < rows[after])
    stamp = stamp.copy()
    stamp[missing] = np.where(between, np.clip(found, low + 1, high - 1), found)
    return stamp
