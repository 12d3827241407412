# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Cut recordings into episodes and align what was done and measured to the frames.

By the marks on /episode, or by pauses of the camera where there are none; by header stamps where
messages have them and by log time where they do not: a frame belongs to an episode whose marks
enclose its stamp, and that is nearest in the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast
import warnings

import numpy as np
from tap_ros.messages.joints import positions_at
from tap_ros.messages.stamps import MAX_GAP
from tap_ros.recording.columns import Columns, pad_objects
from tap_ros.recording.damage import EVERYTHING, FAR, seconds
from tap_ros.recording.episode import Episode, RecordingWarning
from tap_ros.recording.metadata import ArmMount
from tap_ros.recording.reading import AS_RECORDED, Reading
from tap_ros.recording.spans import assign, in_gaps, Mark, MAX_JITTER_NS, read_spans, Span
from tap_ros.robots.arm import get_arm, MOST_JOINTS

MIN_MATCH_NS = 50 * 10**6  # states may be so much off the frame, or half a frame's time
_LOOKED_AT = 4096  # messages looked at together
_EMPTY = {
    'frame_log': ((0,), np.int64), 'frame_stamp': ((0,), np.int64),
    'mask_log': ((0,), np.int64), 'mask_stamp': ((0,), np.int64), 'mask_index': ((0,), np.int64),
    'goal_log': ((0,), np.int64), 'goal_stamp': ((0,), np.int64), 'goal_index': ((0,), np.int64),
    'goal_mask_log': ((0,), np.int64), 'goal_mask_stamp': ((0,), np.int64),
    'goal_mask_index': ((0,), np.int64),
    'twist_log': ((0,), np.int64), 'twist_stamp': ((0,), np.int64),
    'twist': ((0, 3), np.float32),
    'command_log': ((0,), np.int64), 'command': ((0,), np.float32),
    'joint_log': ((0,), np.int64), 'joint_stamp': ((0,), np.int64),
    'joint': ((0, 4), np.float64),
    'arm_log': ((0,), np.int64), 'arm_stamp': ((0,), np.int64),
    'arm': ((0, MOST_JOINTS), np.float64),
    'object_log': ((0,), np.int64), 'object_stamp': ((0,), np.int64),
    'object': ((0, 0, 9), np.float64), 'object_names': ((0,), np.int64),
    'goal_object_log': ((0,), np.int64), 'goal_object_stamp': ((0,), np.int64),
    'goal_object': ((0, 0, 9), np.float64), 'goal_object_names': ((0,), np.int64),
    'gap': ((0, 3), np.int64),
    'mark_log': ((0,), np.int64), 'mark_stamp': ((0,), np.int64), 'mark_event': ((0,), np.int64)}


@dataclass(frozen=True)
class EpisodeTable:
    """The episodes of files that follow each other; F frames in E episodes, K objects at most."""

    parts: Sequence[Columns]  # one a file
    starts: np.ndarray  # (E + 1,) int64: episode i has the rows starts[i] to starts[i + 1]
    spans: list[Span]  # E
    file: np.ndarray  # (F,) int64, index into parts
    row: np.ndarray  # (F,) int64, index into the frames of that part
    mask_file: np.ndarray  # (F,) int64, as file; of the robot mask
    mask_row: np.ndarray  # (F,) int64, index into the masks of that part; -1: there is none
    stamps: np.ndarray  # (F,) int64
    actions: np.ndarray  # (F, 4) float32
    grippers: np.ndarray  # (F, 4) float32
    objects: np.ndarray  # (F, K, 9) float64: u, v, pose
    sources: list[str]  # E, of the objects
    names: list[tuple[str, ...]]  # E
    goals: list[tuple[int, int] | None]  # E: index into parts, index into goal_frames
    goal_masks: list[tuple[int, int] | None]  # E: index into parts, index into goal_masks
    goal_objects: np.ndarray  # (E, K, 9) float64

    def __len__(self) -> int:
        return len(self.spans)

    def frames(self, i: int) -> np.ndarray:
        """Return the frames of episode i, (T, H, W, 3) uint8, a view unless it is in two files."""
        rows = slice(self.starts[i], self.starts[i + 1])
        return _take([part.frames for part in self.parts], self.file[rows], self.row[rows])

    def has_masks(self, i: int) -> bool:
        """Return whether every frame of episode i has a robot mask."""
        return bool((self.mask_row[self.starts[i]:self.starts[i + 1]] >= 0).all())

    def masks(self, i: int) -> np.ndarray | None:
        """Return the robot masks of episode i, (T, H, W) uint8, or None if a frame has none."""
        if not self.has_masks(i):
            return None
        rows = slice(self.starts[i], self.starts[i + 1])
        return _take(
            [part.masks for part in self.parts], self.mask_file[rows], self.mask_row[rows])

    def episode(self, i: int) -> Episode:
        """Return episode i."""
        rows, K = slice(self.starts[i], self.starts[i + 1]), len(self.names[i])
        objects, goal_objects = self.objects[rows, :K], self.goal_objects[i, :K]
        goal, goal_frame, span = self.goals[i], None, self.spans[i]
        if goal is not None and (known := self.parts[goal[0]].goal_frames) is not None:
            goal_frame = known[goal[1]]
        mask, goal_mask = self.goal_masks[i], None
        if goal_frame is not None and mask is not None and (
                known := self.parts[mask[0]].goal_masks) is not None:
            goal_mask = known[mask[1]]
        with np.errstate(over='ignore'):  # absurd pixels become infinite
            pixels, goal_pixels = (
                a[..., :2].astype(np.float32) for a in (objects, goal_objects))
        return Episode(
            frames=self.frames(i), stamps=self.stamps[rows], actions=self.actions[rows],
            grippers=self.grippers[rows], object_names=self.names[i],
            object_source=self.sources[i],
            object_pixels=pixels, object_poses=objects[..., 2:],
            goal_frame=goal_frame, goal_pixels=goal_pixels, goal_poses=goal_objects[:, 2:],
            task=span.task, seed=span.seed, outcome=span.outcome or '',
            robot_masks=self.masks(i), goal_mask=goal_mask)


def _take(arrays: Sequence[np.ndarray | None], file: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return rows of several arrays, a view where they follow each other in one."""
    runs = np.flatnonzero((np.diff(row) != 1) | (np.diff(file) != 0)) + 1
    pieces = [
        cast(np.ndarray, arrays[f[0]])[r[0]:r[-1] + 1]
        for f, r in zip(np.split(file, runs), np.split(row, runs), strict=True)]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def follows(before: Columns, after: Columns) -> bool:
    """
    Tell whether one file goes on where another ends, as the files of a split bag do.

    :param before, after: Columns.
    """
    def times(columns: Columns) -> tuple[list[int], list[int]]:
        logs = [a for k, a in columns.arrays.items() if k.endswith('_log') and len(a)]
        return [log[0] for log in logs], [log[-1] for log in logs]
    (_, ends), (starts, _) = times(before), times(after)
    return not ends or not starts or min(starts) >= max(ends) - MAX_JITTER_NS


def assemble(parts: Sequence[Columns], arm: ArmMount,
             reading: Reading = AS_RECORDED) -> EpisodeTable:
    """
    Cut files that follow each other into episodes.

    :param parts: list of Columns, frames included, in playing order.
    :param arm: where the arm stood.
    :param reading: Reading; it says where episodes are cut that no marks tell apart.
    :return: EpisodeTable; episodes without any frame are left out.
    """
    data, names, marks = _join(parts)
    if len(data['frame_stamp']) > 1 and not data['frame_stamp'].any():
        data['frame_stamp'] = data['frame_log']
    _drop_stops(data)
    for name in ('twist', 'joint', 'arm', 'object'):
        _stamp_unstamped(data, name)
    spans = read_spans(data, marks, reading.gap, reading.episode_seconds)
    owner = _owner(spans, data, parts)
    order = np.lexsort((data['frame_stamp'], owner))
    order = order[owner[order] >= 0]
    owner, stamps = owner[order], data['frame_stamp'][order]
    repeated = (np.diff(stamps, prepend=-1) == 0) & (np.diff(owner, prepend=-1) == 0)
    order, owner, stamps = order[~repeated], owner[~repeated], stamps[~repeated]
    present, owner, counts = np.unique(owner, return_inverse=True, return_counts=True)
    spans = [spans[i] for i in present.tolist()]
    starts = np.concatenate([[0], np.cumsum(counts)])
    clock = _Clock(spans, starts, stamps)
    picked, goal_picked = _pick_names(data, clock)
    goals = [_newest(data, 'goal', span) for span in spans]
    mask_file, mask_row = _masks(data, clock, parts)
    return EpisodeTable(
        parts=parts, starts=starts, spans=spans,
        file=data['frame_file'][order], row=data['frame_row'][order],
        mask_file=mask_file, mask_row=mask_row, stamps=stamps,
        actions=_actions(data, clock, data['frame_log'][order]),
        grippers=_grippers(data, clock, arm, data['frame_log'][order]),
        objects=_by_name(*clock.nearest_rows(data['object_log'], data['object_stamp']),
                         data['object'], data['object_names'], names, picked[clock.owner]),
        sources=[names[i][0] if i >= 0 else '' for i in picked.tolist()],
        names=[names[i][1:] if i >= 0 else () for i in picked.tolist()],
        goals=[None if g < 0 or data['goal_index'][g] < 0
               else (int(data['goal_file'][g]), int(data['goal_index'][g])) for g in goals],
        goal_masks=[_goal_mask(data, span, goal) for span, goal in zip(spans, goals)],
        goal_objects=_by_name(goal_picked, goal_picked >= 0, data['goal_object'],
                              data['goal_object_names'], names, picked))


class _Clock:
    """One increasing time over all frames: the episodes laid end to end with room between."""

    def __init__(self, spans: list[Span], starts: np.ndarray, stamps: np.ndarray) -> None:
        self.spans, self.starts, self.stamps = spans, starts, stamps
        counts = np.diff(starts)
        self.owner = np.repeat(np.arange(len(counts)), counts)  # (F,) episode of each frame
        steps = np.diff(stamps)[np.diff(self.owner) == 0]
        self.match = max(int(np.median(steps)) // 2 if len(steps) else 0, MIN_MATCH_NS)
        self.first, last = stamps[starts[:-1]], stamps[starts[1:] - 1]
        self.length = last - self.first
        self.room = 4 * max(self.match, int(MAX_GAP * 1e9))  # ns between two episodes
        self.base = np.cumsum(self.length + self.room) - self.length - self.room
        self.frames = self.base[self.owner] + stamps - self.first[self.owner]  # (F,) increasing

    def rows(self, log: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (times, rows): of the messages that belong to an episode, sorted by time."""
        if not len(self.spans):
            return np.empty(0, np.int64), np.empty(0, np.int64)
        owner = assign(self.spans, log, stamps)
        since = stamps - self.first[owner]
        rows = np.flatnonzero(
            (owner >= 0) & (since >= -self.match) & (since <= self.length[owner] + self.match))
        times = self.base[owner[rows]] + since[rows]
        order = np.argsort(times, kind='stable')
        return times[order], rows[order]

    def nearest_rows(self, log: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (rows, found): for each frame the message nearest in time, or the newest."""
        times, rows = self.rows(log, stamps)
        if not len(times):
            return np.zeros(len(self.frames), np.int64), np.zeros(len(self.frames), bool)
        after = np.searchsorted(times, self.frames, 'right')
        before = np.maximum(after - 1, 0)
        after = np.minimum(after, len(times) - 1)
        nearer = np.abs(times[after] - self.frames) < np.abs(times[before] - self.frames)
        best = np.where(nearer, after, before)
        return rows[best], np.abs(times[best] - self.frames) <= self.match

    def positions(self, log: np.ndarray, stamps: np.ndarray, values: np.ndarray) -> np.ndarray:
        """
        Return where joints were at each frame, (F, J) float64, NaN where it is unknown.

        :param log, stamps: (N,) ns.
        :param values: (N, J) float64, NaN for a joint that a message does not tell of.
        """
        times, rows = self._around(log, stamps)
        columns = []
        for column in values[rows].T:
            told = np.isfinite(column)
            columns.append(positions_at(times[told], column[told], self.frames, self.match))
        return np.stack(columns, 1)

    def _around(self, log: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as rows, also of messages a little before and after the episodes."""
        starts, ends = np.array(
            [(s.start_log, s.end_log) for s in self.spans], np.int64).reshape(-1, 2).T
        inside, reach = np.searchsorted(starts, log, 'right') - 1, self.room // 2
        times, rows = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for owner in (inside - 1, inside, inside + 1):  # what lies between two belongs to both
            kept = np.flatnonzero((owner >= 0) & (owner < len(self.spans)))
            own = owner[kept]
            since = stamps[kept] - self.first[own]
            near = ((since >= -reach) & (since <= self.length[own] + reach)
                    & (log[kept] >= starts[own] - MAX_JITTER_NS)
                    & (log[kept] <= ends[own] + MAX_JITTER_NS))
            times.append(self.base[own[near]] + since[near])
            rows.append(kept[near])
        at, found = np.concatenate(times), np.concatenate(rows)
        order = np.lexsort((found, at))
        return at[order], found[order]


def _join(parts: Sequence[Columns]) -> tuple[
        dict[str, np.ndarray], list[tuple[str, ...]], list[Mark]]:
    """Put the columns of several files one behind the other."""
    data: dict[str, list[np.ndarray]] = {
        key: [] for key in (
            *_EMPTY, 'frame_file', 'frame_row', 'mask_file', 'goal_file', 'goal_mask_file')}
    numbers: dict[tuple[str, ...], int] = {}
    marks: list[Mark] = []
    newest = -FAR
    for index, part in enumerate(parts):
        arrays = {k: part.arrays.get(k, np.empty(s, d)) for k, (s, d) in _EMPTY.items()}
        local = np.array(
            [numbers.setdefault(tuple(n), len(numbers)) for n in part.names], np.int64)
        for key in ('object_names', 'goal_object_names'):
            arrays[key] = local[arrays[key]]
        arrays['frame_file'] = np.full(len(arrays['frame_log']), index)
        unplaced = arrays['gap'][:, :1] <= -FAR  # of files of which nothing could be read
        arrays['gap'] = np.where(unplaced & [[True, True, False]], newest, arrays['gap'])
        newest = max([newest, *(int(log.max()) for key, log in part.arrays.items()
                                if key.endswith('_log') and len(log))])
        arrays['frame_row'] = np.arange(len(arrays['frame_log']))
        for key in ('mask', 'goal', 'goal_mask'):
            arrays[f'{key}_file'] = np.full(len(arrays[f'{key}_log']), index)
        marks += part.marks
        for key, value in arrays.items():
            data[key].append(value)
    objects = data['object'] + data['goal_object']
    rows = [len(part) for part in objects]
    objects = np.split(pad_objects(
        np.concatenate([part.reshape(-1, 9) for part in objects]),
        np.repeat([part.shape[1] for part in objects], rows)), np.cumsum(rows)[:-1])
    data['object'], data['goal_object'] = objects[:len(parts)], objects[len(parts):]
    return {key: np.concatenate(value) for key, value in data.items()}, list(numbers), marks


def _owner(spans: list[Span], data: dict[str, np.ndarray], parts: Sequence[Columns]) -> np.ndarray:
    """Return (F,) int64: the episode of each frame, -1 for none; count those nobody knows."""
    owner = assign(spans, data['frame_log'], data['frame_stamp'])
    unsure = np.array([span.outcome is None for span in spans])[owner]
    unsure = (owner >= 0) & (unsure | in_gaps(data['gap'], data['frame_log']))
    for index in np.unique(data['frame_file'][unsure]).tolist():
        logs = data['frame_log'][unsure & (data['frame_file'] == index)]
        warnings.warn(
            f'{parts[index].source}: {len(logs)} frames beside what is lost are left out, as '
            'nothing tells which episode they belong to (log time '
            f'{seconds(int(logs.min()))} to {seconds(int(logs.max()))} s)',
            RecordingWarning, stacklevel=4)
    return np.where(unsure, -1, owner)


def _drop_stops(data: dict[str, np.ndarray]) -> None:
    """
    Leave out zero twists without a stamp among stamped ones: they say stop, and answer no frame.

    As the last command before the next frame, such a one would take the place of the action.
    """
    stops = (data['twist_stamp'] == 0) & ~data['twist'].any(1)
    if (data['twist_stamp'] != 0).any():
        for key in ('twist', 'twist_log', 'twist_stamp'):
            data[key] = data[key][~stops]


def _stamp_unstamped(data: dict[str, np.ndarray], name: str) -> None:
    """Give messages without a stamp that of the newest frame logged before."""
    stamps, frames = data[f'{name}_stamp'], data['frame_stamp']
    if len(frames) and (stamps == 0).any():
        newest = np.searchsorted(data['frame_log'], data[f'{name}_log'], 'right') - 1
        data[f'{name}_stamp'] = np.where(stamps == 0, frames[np.maximum(newest, 0)], stamps)


def _actions(data: dict[str, np.ndarray], clock: _Clock, frame_log: np.ndarray) -> np.ndarray:
    """
    Return (F, 4) float32: row t is what was sent between frame t and frame t + 1, the last wins.

    A gripper opening holds until another is commanded. The last row of an episode is zeros.
    """
    actions = np.zeros((len(clock.frames), 4), np.float32)
    times, rows = clock.rows(data['twist_log'], data['twist_stamp'])
    step = np.searchsorted(clock.frames, times, 'right') - 1
    actions[step[step >= 0], :3] = data['twist'][rows[step >= 0]]
    by_log = np.argsort(frame_log, kind='stable')
    if len(data['command_log']) and len(frame_log):
        step = np.searchsorted(frame_log[by_log], data['command_log'], 'right') - 1
        newest = np.full(len(frame_log), -1)
        newest[by_log[step[step >= 0]]] = np.flatnonzero(step >= 0)
        newest = np.maximum.accumulate(newest)
        earliest = np.searchsorted(data['command_log'], _begins(clock, frame_log))
        known = newest >= earliest[clock.owner]
        actions[known, 3] = data['command'][newest[known]]
    actions[clock.starts[1:] - 1] = 0
    return actions


def _grippers(data: dict[str, np.ndarray], clock: _Clock, arm: ArmMount,
              frame_log: np.ndarray) -> np.ndarray:
    """
    Return (F, 4) float32: the gripper's state at each frame, NaN where unknown.

    As messages.joints.GripperHistory has it live: where it is not told, it follows from the arm's
    joints, and an opening that is told now and then holds.
    """
    beside = np.isfinite(data['joint'][:, :3]).any(1)  # the opening beside the place
    told = clock.positions(data['joint_log'], data['joint_stamp'], np.where(
        beside[:, None], data['joint'], np.nan))
    arms = clock.positions(data['arm_log'], data['arm_stamp'], data['arm'])
    found = np.isnan(told[:, :3]).all(1) & np.isfinite(arms).all(1)
    kind = get_arm(arm.arm)
    told[found, :3] = kind.gripper_at(arms[found, :len(kind.joints)], arm.mount)
    opened = np.flatnonzero(np.isfinite(data['joint'][:, 3]))
    newest = np.searchsorted(data['joint_log'][opened], frame_log, 'right') - 1
    held = np.append(data['joint'][opened, 3], np.nan)[newest]  # -1: nothing tells it
    unknown = np.isnan(told[:, 3]) & np.isfinite(told[:, :3]).all(1)
    told[unknown, 3] = np.where(
        np.isnan(held) & found, arm.opening, held)[unknown]
    return told.astype(np.float32)


def _begins(clock: _Clock, frame_log: np.ndarray) -> np.ndarray:
    """Return (E,) log times from which commands count: of the first frame, cut off or not."""
    begins = frame_log[clock.starts[:-1]]
    for i, span in enumerate(clock.spans):
        cut, before = span.first_cut, clock.spans[i - 1] if i else None
        if cut is not None:
            begins[i] = min(begins[i], cut)
            if before is not None and (before.first_cut == cut or before.end_log == cut - 1):
                begins[i] = min(begins[i], begins[i - 1])
    return begins


def _newest(data: dict[str, np.ndarray], name: str, span: Span) -> int:
    """
    Return the row of the last message up to the end of an episode, -1 for none.

    What was said before messages were lost does not hold after it.
    """
    log, stamps = data[f'{name}_log'], data[f'{name}_stamp']
    lost = data['gap'][(data['gap'][:, 2] == EVERYTHING) & (data['gap'][:, 0] <= span.end_log), 1]
    first = int(np.searchsorted(log, lost.max())) if len(lost) else 0
    end = int(np.searchsorted(log, span.end_log, 'right'))
    while end > first:
        start = max(end - _LOOKED_AT, first)
        known = np.flatnonzero(stamps[start:end] <= span.end_stamp)
        if len(known):
            return start + int(known[-1])
        end = start
    return -1


def _masks(data: dict[str, np.ndarray], clock: _Clock,
           parts: Sequence[Columns]) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (F,) int64 file and row of each frame's robot mask, row -1 where there is none.

    A mask belongs to the picture of its own stamp alone: the one before or after shows the robot
    elsewhere, which is worse than none.
    """
    file = np.full(len(clock.frames), -1)
    row = file.copy()
    times, rows = clock.rows(data['mask_log'], data['mask_stamp'])
    if len(times):
        first = np.minimum(np.searchsorted(times, clock.frames), len(times) - 1)
        found = times[first] == clock.frames
        file[found], row[found] = (
            data[key][rows[first[found]]] for key in ('mask_file', 'mask_index'))
    lacking = row < 0
    if len(data['mask_log']) and lacking.any():
        warnings.warn(
            f'{parts[0].source}: {len(np.unique(clock.owner[lacking]))} of {len(clock.spans)} '
            f'episodes have frames without a robot mask of their stamp ({lacking.sum()} frames, '
            f'the first at {seconds(int(clock.stamps[lacking][0]))} s); the masks of these '
            'episodes are not used', RecordingWarning, stacklevel=4)
    return file, row


def _goal_mask(data: dict[str, np.ndarray], span: Span, goal: int) -> tuple[int, int] | None:
    """Return file and row of the robot mask of a goal picture; None without one of its stamp."""
    mask = _newest(data, 'goal_mask', span)
    if min(goal, mask) < 0 or data['goal_mask_index'][mask] < 0 or (
            data['goal_mask_stamp'][mask] != data['goal_stamp'][goal]):
        return None
    return int(data['goal_mask_file'][mask]), int(data['goal_mask_index'][mask])


def _pick_names(data: dict[str, np.ndarray], clock: _Clock) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each episode's object names and the row of its goal objects, or -1."""
    rows, found = clock.nearest_rows(data['object_log'], data['object_stamp'])
    seen = np.where(found, data['object_names'][rows] if len(data['object_names']) else -1, -1)
    goal_rows = np.array([
        _newest(data, 'goal_object', span) for span in clock.spans], np.int64)
    picked = np.full(len(goal_rows), -1)
    for i, goal in enumerate(goal_rows.tolist()):
        known = seen[clock.starts[i]:clock.starts[i + 1]]
        known = known[known >= 0]
        if len(known):
            picked[i] = known[0]
        elif goal >= 0:
            picked[i] = data['goal_object_names'][goal]
    return picked, goal_rows


def _by_name(rows: np.ndarray, found: np.ndarray, values: np.ndarray, numbers: np.ndarray,
             names: Sequence[tuple[str, ...]], wanted: np.ndarray) -> np.ndarray:
    """
    Return (N, K, 9): the values of picked messages with their objects in the wanted order.

    :param rows, found: (N,) row of the message and whether there is one.
    :param values, numbers: (M, K, 9) of all messages, and (M,) the number of their names.
    :param names, wanted: tuples by number, as in Columns, and (N,) the number of the wanted names.
    """
    out = np.full((len(rows), *values.shape[1:]), np.nan)
    out[found] = values[rows[found]]
    orders = {}  # (number, wanted) -> for each wanted name its place, and those that have one
    for i in np.flatnonzero(found)[numbers[rows[found]] != wanted[found]].tolist():
        key = int(numbers[rows[i]]), int(wanted[i])
        if key not in orders:
            place = {name: k for k, name in reversed(list(enumerate(names[key[0]][1:])))}
            pairs = [(k, place[n]) for k, n in enumerate(names[key[1]][1:]) if n in place]
            orders[key] = np.array(pairs, np.int64).reshape(-1, 2).T
        to, of = orders[key]
        out[i] = np.nan
        out[i, to] = values[rows[i], of]
    return out
