# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Cut recordings into episodes and align what was done and measured to the frames.

By the marks on /episode, or by pauses of the camera where there are none; by header stamps where
messages have them and by log time where they do not: a frame belongs to an episode whose marks
enclose its stamp, and that is nearest in the log.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
import warnings

import numpy as np
from tap_ros.base.errors import RecordingWarning
from tap_ros.messages.joints import contradicted, PLACE, positions_at
from tap_ros.messages.stamps import MAX_GAP
from tap_ros.recording.columns import Columns, NAMES, Track
from tap_ros.recording.defects import FAR, seconds
from tap_ros.recording.episode import EpisodeTable
from tap_ros.recording.metadata import ArmMount
from tap_ros.recording.periods import command_units
from tap_ros.recording.reading import AS_RECORDED, Reading
from tap_ros.recording.spans import assign, in_gaps, MAX_JITTER_NS, Span
from tap_ros.recording.tracks import read_tracks
from tap_ros.robots.arm import get_arm, MOST_JOINTS

MIN_MATCH_NS = 50 * 10**6  # states may be so much off the frame, or half a frame's time


def runs_of(parts: Iterable[Columns]) -> list[list[Columns]]:
    """Split the files of a bag where one does not go on where the one before ended."""
    runs: list[list[Columns]] = []
    newest = shown = -FAR  # log times of any message, and of a frame
    for part in parts:
        logs, frames = part.logs(NAMES), part.logs(['frame'])
        if (not runs or logs.min(initial=FAR) < newest - MAX_JITTER_NS
                or frames.min(initial=FAR) < shown - MIN_MATCH_NS):
            runs.append([])
        runs[-1].append(part)
        newest, shown = (int(times.max(initial=-FAR)) for times in (logs, frames))
    return runs


def assemble(parts: Sequence[Columns], arm: ArmMount,
             reading: Reading = AS_RECORDED, period: float | None = None) -> EpisodeTable:
    """
    Cut files that follow each other into episodes.

    :param parts: list of Columns, pictures included, in playing order.
    :param arm: where the arm stood.
    :param reading: Reading; it says where episodes are cut that no marks tell apart.
    :param period: of control, s, that earlier files of the bag told last; None: they told none.
    :return: EpisodeTable; episodes without any frame are left out.
    """
    tracks, names, gaps, spans = read_tracks(parts, reading)
    frame = tracks['frame']
    owner = _owner(spans, frame, gaps, parts)
    order = np.lexsort((frame.stamp, owner))
    frame, owner = frame.take(order[owner[order] >= 0]), owner[order[owner[order] >= 0]]
    frame, owner = _without_repeats(frame, owner)
    present, counts = np.unique(owner, return_counts=True)
    spans = [spans[i] for i in present.tolist()]
    clock = _Clock(spans, np.concatenate([[0], np.cumsum(counts)]), frame)
    picked, goal_rows = _pick_names(tracks, clock, gaps)
    names.append(('',))  # of number -1, where there are none
    measured, signals = _signals(tracks['signal'], clock, names)
    return EpisodeTable(
        parts=parts, starts=clock.starts, spans=spans, stamps=frame.stamp, logs=frame.log,
        places={'frame': (frame.file, frame.index), 'mask': _masks(tracks['mask'], clock, parts),
                **_goals(tracks, spans, gaps)},
        actions=_actions(tracks, clock, lambda rows: command_units(
            parts, tracks, gaps, rows, period)),
        grippers=_grippers(tracks, clock, arm, parts[0].source),
        objects=_by_name(*clock.nearest_rows(tracks['object']), tracks['object'], names,
                         picked[clock.owner]),
        names=[names[i] for i in picked.tolist()],
        goal_objects=_by_name(goal_rows, goal_rows >= 0, tracks['goal_object'], names, picked),
        signals=signals, signal_names=measured)


class _Clock:
    """One increasing time over all frames: the episodes laid end to end with room between."""

    def __init__(self, spans: list[Span], starts: np.ndarray, frame: Track) -> None:
        self.spans, self.starts, self.frame = spans, starts, frame
        stamps, counts = frame.stamp, np.diff(starts)
        self.owner = np.repeat(np.arange(len(counts)), counts)  # (F,) episode of each frame
        steps = np.diff(stamps)[np.diff(self.owner) == 0]
        self.match = max(int(np.median(steps)) // 2 if len(steps) else 0, MIN_MATCH_NS)
        self.first, last = stamps[starts[:-1]], stamps[starts[1:] - 1]
        self.length = last - self.first
        self.room = 4 * max(self.match, int(MAX_GAP * 1e9))  # ns between two episodes
        self.base = np.cumsum(self.length + self.room) - self.length - self.room
        self.times = self.base[self.owner] + stamps - self.first[self.owner]  # (F,) increasing

    def rows(self, track: Track) -> tuple[np.ndarray, np.ndarray]:
        """Return (times, rows): of the messages that belong to an episode, sorted by time."""
        if not len(self.spans):
            return np.empty(0, np.int64), np.empty(0, np.int64)
        owner = assign(self.spans, track)
        since = track.stamp - self.first[owner]
        rows = np.flatnonzero(
            (owner >= 0) & (since >= -self.match) & (since <= self.length[owner] + self.match))
        times = self.base[owner[rows]] + since[rows]
        order = np.argsort(times, kind='stable')
        return times[order], rows[order]

    def nearest_rows(self, track: Track) -> tuple[np.ndarray, np.ndarray]:
        """Return (rows, found): for each frame the message nearest in time, or the newest."""
        times, rows = self.rows(track)
        if not len(times):
            return np.zeros(len(self.times), np.int64), np.zeros(len(self.times), bool)
        after = np.searchsorted(times, self.times, 'right')
        before = np.maximum(after - 1, 0)
        after = np.minimum(after, len(times) - 1)
        nearer = np.abs(times[after] - self.times) < np.abs(times[before] - self.times)
        best = np.where(nearer, after, before)
        return rows[best], np.abs(times[best] - self.times) <= self.match

    def positions(self, track: Track, values: np.ndarray,
                  places: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return where joints were at each frame, (F, J) float64, NaN where it is unknown.

        :param track: N messages.
        :param values: (N, J) float64, NaN for a joint that a message does not tell of.
        :param places: of so many first joints positions that contradict others are left out.
        :return: that, and of which messages some are, (N,) bool.
        """
        times, rows = self._around(track)
        columns, wrong = [], np.zeros(len(track), bool)
        if len(times) and np.isin(times, self.times).mean() > 0.5:
            places = 0  # who tells of each frame tells of nothing else
        for k, column in enumerate(values[rows].T):
            told = np.isfinite(column)
            if k < places:
                left_out = contradicted(times[told], column[told])
                wrong[rows[told][left_out]] = True
                told[np.flatnonzero(told)[left_out]] = False
            columns.append(positions_at(times[told], column[told], self.times, self.match))
        return np.stack(columns, 1), wrong

    def _around(self, track: Track) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as rows, also of messages a little before and after the episodes."""
        starts, ends = np.array(
            [(s.start_log, s.end_log) for s in self.spans], np.int64).reshape(-1, 2).T
        inside, reach = np.searchsorted(starts, track.log, 'right') - 1, self.room // 2
        times, rows = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for owner in (inside - 1, inside, inside + 1):  # what lies between two belongs to both
            kept = np.flatnonzero((owner >= 0) & (owner < len(self.spans)))
            own, log = owner[kept], track.log[kept]
            since = track.stamp[kept] - self.first[own]
            near = ((since >= -reach) & (since <= self.length[own] + reach)
                    & (log >= starts[own] - MAX_JITTER_NS) & (log <= ends[own] + MAX_JITTER_NS))
            times.append(self.base[own[near]] + since[near])
            rows.append(kept[near])
        at, found = np.concatenate(times), np.concatenate(rows)
        order = np.lexsort((found, at))
        return at[order], found[order]


def _owner(spans: list[Span], frame: Track, gaps: np.ndarray,
           parts: Sequence[Columns]) -> np.ndarray:
    """Return (F,) int64: the episode of each frame, -1 for none; count those nobody knows."""
    owner = assign(spans, frame)
    unsure = np.array([span.outcome is None for span in spans])[owner]
    unsure = (owner >= 0) & (unsure | in_gaps(gaps, frame.log))
    for index in np.unique(frame.file[unsure]).tolist():
        logs = frame.log[unsure & (frame.file == index)]
        warnings.warn(
            f'{parts[index].source}: {len(logs)} frames beside what is lost are left out, as '
            'nothing tells which episode they belong to (log time '
            f'{seconds(int(logs.min()))} to {seconds(int(logs.max()))} s)',
            RecordingWarning, stacklevel=4)
    return np.where(unsure, -1, owner)


def _without_repeats(frame: Track, owner: np.ndarray) -> tuple[Track, np.ndarray]:
    """Leave out pictures that are there twice; others of one stamp follow each other."""
    stamp = frame.stamp.copy()

    def same() -> np.ndarray:
        return np.append(False, (np.diff(stamp) == 0) & (np.diff(owner) == 0))
    if not same().any():
        return frame, owner
    kept = np.flatnonzero(~same() | (np.diff(frame.picked()[:, 0], prepend=np.nan) != 0))
    frame, owner, stamp = frame.take(kept), owner[kept], stamp[kept]
    while same().any():
        stamp += same()
    return replace(frame, stamp=stamp), owner


def _actions(tracks: dict[str, Track], clock: _Clock,
             units: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """
    Return (F, 4) float32: row t is what was sent between frame t and frame t + 1, the last wins.

    A gripper opening holds until another is commanded. The last row of an episode is zeros.

    :param units: returns what rows of commands are multiplied by, see command_units.
    """
    actions = np.zeros((len(clock.times), 4), np.float32)
    twist, command, logs = tracks['twist'], tracks['command'], clock.frame.log
    times, rows = clock.rows(twist)
    step = np.searchsorted(clock.times, times, 'right') - 1
    with np.errstate(over='ignore'):  # absurd numbers become infinite
        actions[step[step >= 0], :3] = (units(rows) * twist.picked(rows))[step >= 0]
        if len(command) and len(logs):
            by_log = np.argsort(logs, kind='stable')
            newest = np.empty(len(logs), np.int64)
            newest[by_log] = np.searchsorted(command.log, np.append(logs[by_log[1:]], FAR)) - 1
            earliest = np.searchsorted(command.log, logs[clock.starts[:-1]])
            known = newest >= earliest[clock.owner]
            actions[known, 3] = command.picked(newest[known])[:, 0]
    actions[clock.starts[1:] - 1] = 0
    return actions


def _grippers(tracks: dict[str, Track], clock: _Clock, arm: ArmMount,
              source: str) -> np.ndarray:
    """
    Return (F, 4) float32: the gripper's state at each frame, NaN where unknown.

    As messages.joints.GripperHistory has it live: where it is not told, it follows from the arm's
    joints, and an opening that is told now and then holds.
    """
    joint, values = tracks['joint'], tracks['joint'].picked()
    beside = np.isfinite(values[:, :3]).any(1)  # the opening beside the place
    told, wrong = clock.positions(joint, np.where(beside[:, None], values, np.nan), len(PLACE))
    arms, others = clock.positions(tracks['arm'], tracks['arm'].picked(), MOST_JOINTS)
    if count := int(wrong.sum() + others.sum()):
        warnings.warn(
            f'{source}: {count} of {len(joint) + len(others)} joint states contradict those near '
            'them, as where two nodes publish joint states, or a driver sends zeros; they are not '
            'used, and where nothing else tells it the place of the gripper is unknown',
            RecordingWarning, stacklevel=4)
    found = np.isnan(told[:, :3]).all(1) & np.isfinite(arms).all(1)
    kind = get_arm(arm.arm)
    told[found, :3] = kind.gripper_at(arms[found, :len(kind.joints)], arm.mount)
    opened = np.flatnonzero(np.isfinite(values[:, 3]))
    newest = np.searchsorted(joint.log[opened], clock.frame.log, 'right') - 1
    held = np.append(values[opened, 3], np.nan)[newest]  # -1: nothing tells it
    unknown = np.isnan(told[:, 3]) & np.isfinite(told[:, :3]).all(1)
    told[unknown, 3] = np.where(np.isnan(held) & found, arm.opening, held)[unknown]
    return told.astype(np.float32)


def _newest(track: Track, span: Span, gaps: np.ndarray) -> int:
    """
    Return the row of the last message up to the end of an episode, -1 for none.

    What was said before messages were lost does not hold after it.
    """
    lost = gaps[gaps[:, 0] <= span.end_log, 1]
    first = int(np.searchsorted(track.log, lost.max())) if len(lost) else 0
    end = int(np.searchsorted(track.log, span.end_log, 'right'))
    known = np.flatnonzero(track.stamp[first:end] <= span.end_stamp)
    return first + int(known[-1]) if len(known) else -1


def _goals(tracks: dict[str, Track], spans: Sequence[Span],
           gaps: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the goal picture of each episode and its robot mask, as EpisodeTable.places."""
    places = np.full((2, 2, len(spans)), -1)  # picture or mask, file or row
    for i, span in enumerate(spans):
        stamps = []
        for k, name in enumerate(('goal', 'goal_mask')):
            track, row = tracks[name], _newest(tracks[name], span, gaps)
            if row >= 0 and track.index[row] >= 0:
                places[k, :, i] = track.file[row], track.index[row]
                stamps.append(track.stamp[row])
        if places[0, 1, i] < 0 or len(set(stamps)) > 1:  # a mask is that of its own picture
            places[1, :, i] = -1
    return {'goal': (*places[0],), 'goal_mask': (*places[1],)}


def _masks(mask: Track, clock: _Clock,
           parts: Sequence[Columns]) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (F,) int64 file and row of each frame's robot mask, row -1 where there is none.

    A mask belongs to the picture of its own stamp alone: the one before or after shows the robot
    elsewhere, which is worse than none.
    """
    file, row = np.full((2, len(clock.times)), -1)
    times, rows = clock.rows(mask)
    if len(times):
        first = np.minimum(np.searchsorted(times, clock.times), len(times) - 1)
        found = times[first] == clock.times
        file[found], row[found] = mask.file[rows[first[found]]], mask.index[rows[first[found]]]
    lacking = row < 0
    if len(mask) and lacking.any():
        warnings.warn(
            f'{parts[0].source}: {len(np.unique(clock.owner[lacking]))} of {len(clock.spans)} '
            f'episodes have frames without a robot mask of their stamp ({lacking.sum()} frames, '
            f'the first at {seconds(int(clock.frame.stamp[lacking][0]))} s); the masks of these '
            'episodes are not used', RecordingWarning, stacklevel=4)
    return file, row


def _pick_names(tracks: dict[str, Track], clock: _Clock,
                gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each episode's object names and the row of its goal objects, or -1."""
    rows, found = clock.nearest_rows(tracks['object'])
    seen = np.where(found, np.append(tracks['object'].index, -1)[rows], -1)
    goal_rows = np.array([
        _newest(tracks['goal_object'], span, gaps) for span in clock.spans], np.int64)
    picked = np.full(len(goal_rows), -1)
    for i, goal in enumerate(goal_rows.tolist()):
        known = seen[clock.starts[i]:clock.starts[i + 1]]
        known = known[known >= 0]
        if len(known):
            picked[i] = known[0]
        elif goal >= 0:
            picked[i] = tracks['goal_object'].index[goal]
    return picked, goal_rows


def _signals(signal: Track, clock: _Clock, names: Sequence[tuple[str, ...]],
             ) -> tuple[list[tuple[str, ...]], np.ndarray]:
    """Return the names of each episode's signals, those of its first message, and (F, D)."""
    rows, found = clock.nearest_rows(signal)
    seen = np.where(found, np.append(signal.index, -1)[rows], -1)
    first = np.array([next(iter(own[own >= 0]), -1) for own in (
        seen[a:b] for a, b in zip(clock.starts, clock.starts[1:]))], np.int64)
    return ([names[i][1:] for i in first.tolist()],
            _by_name(rows, found, signal, names, first[clock.owner])[..., 0])


def _by_name(rows: np.ndarray, found: np.ndarray, track: Track,
             names: Sequence[tuple[str, ...]], wanted: np.ndarray) -> np.ndarray:
    """Return (N, K, width): values of N rows that are found, in the order of names[wanted]."""
    most = max((len(names[i]) - 1 for i in np.unique(wanted).tolist()), default=0)
    out = np.full((len(rows), most, track.values.shape[1]), np.nan)
    numbers = np.where(found, np.append(track.index, -1)[rows], -1)
    for number, want in np.unique(np.stack([numbers, wanted], 1)[found], axis=0).tolist():
        same = np.flatnonzero(found & (numbers == number) & (wanted == want))
        place = {name: k for k, name in reversed(list(enumerate(names[number][1:])))}
        first = track.first[rows[same]]
        for k, name in enumerate(names[want][1:]):
            if name in place:
                out[same, k] = track.values[first + (k if number == want else place[name])]
    return out
