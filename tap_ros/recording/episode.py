# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One episode of a recording as arrays: what every part of this package trains on and evaluates.

T frames of H x W pixels, K objects. Actions and states follow the control contract: an action is
dx, dy, dz in metres per control period and the gripper opening, 0 closed to 1 open.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.base.contract import MOST_SIGNALS
from tap_ros.base.errors import ImageError, RecordingError
from tap_ros.images.pixels import check_mask

if TYPE_CHECKING:
    from tap_ros.recording.columns import Columns
    from tap_ros.recording.spans import Span

OUTCOMES = ('success', 'failure', 'interrupted', '')


@dataclass(frozen=True)
class Episode:
    """What was seen and done between the start and the end of one episode."""

    frames: np.ndarray  # (T, H, W, 3) uint8, rgb
    stamps: np.ndarray  # (T,) int64, nanoseconds, increasing
    # (T, 4) float32; row t leads from frame t to t + 1; the last row is zeros; NaN is not written
    actions: np.ndarray
    grippers: np.ndarray  # (T, 4) float32 x, y, z (m, world), opening; NaN where unknown
    object_names: tuple[str, ...]  # K
    object_pixels: np.ndarray  # (T, K, 2) float32 (u, v); NaN where unknown
    object_poses: np.ndarray  # (T, K, 7) float64 x y z (m, world) qx qy qz qw; NaN where unknown
    goal_frame: np.ndarray | None  # (H, W, 3) uint8: the picture of the goal
    goal_pixels: np.ndarray  # (K, 2) float32; NaN where unknown
    goal_poses: np.ndarray  # (K, 7) float64; NaN where unknown
    object_source: str = ''  # of the objects: ground_truth, tracked or imported; '': unknown
    task: str = ''  # for example 'push2'; '' when unknown
    seed: int = 0
    outcome: str = ''  # one of OUTCOMES
    # (T, H, W) uint8, ROBOT_MASK_FREE, _HAND or _ARM; None unless every frame has one
    robot_masks: np.ndarray | None = None
    goal_mask: np.ndarray | None = None  # (H, W) uint8: of the picture of the goal
    signal_names: tuple[str, ...] = ()  # D, of whatever else was measured or commanded
    signals: np.ndarray | None = None  # (T, D) float32; NaN where unknown; None without names

    def __len__(self) -> int:
        """Return the number of frames T."""
        return len(self.frames)


def check_episode(episode: Episode) -> None:
    """
    Accept an episode or say what is wrong with it.

    :param episode: what should be a complete Episode with at least one frame.
    :raises RecordingError: for another type, shape or order; the message names the field.
    """
    T, K = len(episode.stamps), len(episode.object_names)
    size = tuple(np.shape(episode.frames)[1:3])
    wanted = {
        'frames': ((T, *size, 3), np.uint8), 'stamps': ((T,), np.int64),
        'actions': ((T, 4), np.float32), 'grippers': ((T, 4), np.float32),
        'object_pixels': ((T, K, 2), np.float32), 'object_poses': ((T, K, 7), np.float64),
        'goal_pixels': ((K, 2), np.float32), 'goal_poses': ((K, 7), np.float64),
        'goal_frame': ((*size, 3), np.uint8), 'robot_masks': ((T, *size), np.uint8),
        'goal_mask': (size, np.uint8), 'signals': ((T, len(episode.signal_names)), np.float32)}
    for field in ('goal_frame', 'robot_masks', 'goal_mask', 'signals'):
        if getattr(episode, field) is None:
            del wanted[field]
    for field, (shape, dtype) in wanted.items():
        array = np.asarray(getattr(episode, field))
        if array.shape != shape or array.dtype != dtype:
            raise RecordingError(
                f'Episode.{field}: expected shape {shape} and type {np.dtype(dtype)}, '
                f'got {array.shape} and {array.dtype}')
    for field in ('robot_masks', 'goal_mask'):
        try:
            if getattr(episode, field) is not None:
                check_mask(getattr(episode, field))
        except ImageError as error:
            raise RecordingError(f'Episode.{field}: {error}') from error
    if episode.goal_mask is not None and episode.goal_frame is None:
        raise RecordingError('Episode.goal_mask: expected None, as there is no goal_frame')
    if (episode.signals is None) != (not episode.signal_names) or not len(
            episode.signal_names) <= MOST_SIGNALS:
        raise RecordingError('Episode.signals: expected a column for each of signal_names, at '
                             f'most {MOST_SIGNALS}')
    if T == 0 or 0 in size:
        raise RecordingError('Episode.frames: expected at least one frame of at least one pixel')
    if episode.stamps[0] < 0 or (np.diff(episode.stamps) <= 0).any():
        raise RecordingError('Episode.stamps: expected nanoseconds >= 0 that increase')
    if episode.actions[-1].any():
        raise RecordingError('Episode.actions: expected zeros in the last row')
    if episode.outcome not in OUTCOMES:
        raise RecordingError(
            f'Episode.outcome: expected one of {OUTCOMES}, got {episode.outcome!r}')


@dataclass(frozen=True)
class EpisodeTable:
    """The episodes of files that follow each other; F frames in E episodes, K objects at most."""

    parts: Sequence['Columns']  # one a file
    starts: np.ndarray  # (E + 1,) int64: episode i has the rows starts[i] to starts[i + 1]
    spans: 'list[Span]'  # E
    places: dict[str, tuple[np.ndarray, np.ndarray]]  # of 'frame' and 'mask' (F,), and of 'goal'
    # and 'goal_mask' (E,): index into parts, and into their pictures, -1 for none; int64
    stamps: np.ndarray  # (F,) int64
    logs: np.ndarray  # (F,) int64: when frames were recorded
    actions: np.ndarray  # (F, 4) float32
    grippers: np.ndarray  # (F, 4) float32
    objects: np.ndarray  # (F, K, 9) float64: u, v, pose
    names: list[tuple[str, ...]]  # E: source of the objects, then theirs
    goal_objects: np.ndarray  # (E, K, 9) float64
    signals: np.ndarray  # (F, D) float64, D at most
    signal_names: list[tuple[str, ...]]  # E

    def __len__(self) -> int:
        return len(self.spans)

    def pictures(self, name: str, rows: slice) -> np.ndarray | None:
        """Return pictures, a view unless they are in two files; None where one is lacking."""
        file, row = (places[rows] for places in self.places[name])
        if (row < 0).any():
            return None
        runs = np.flatnonzero((np.diff(row) != 1) | (np.diff(file) != 0)) + 1
        pieces = [self.parts[f[0]].pictures[name][r[0]:r[-1] + 1]
                  for f, r in zip(np.split(file, runs), np.split(row, runs), strict=True)]
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)

    def frames(self, i: int) -> np.ndarray:
        """Return the frames of episode i, (T, H, W, 3) uint8."""
        frames = self.pictures('frame', slice(self.starts[i], self.starts[i + 1]))
        assert frames is not None
        return frames

    def has_masks(self, i: int) -> bool:
        """Return whether every frame of episode i has a robot mask."""
        return bool((self.places['mask'][1][self.starts[i]:self.starts[i + 1]] >= 0).all())

    def episode(self, i: int) -> Episode:
        """Return episode i."""
        rows, (source, *names) = slice(self.starts[i], self.starts[i + 1]), self.names[i]
        objects, goals = self.objects[rows, :len(names)], self.goal_objects[i, :len(names)]
        goal_frame, goal_mask = (
            self.pictures(name, slice(i, i + 1)) for name in ('goal', 'goal_mask'))
        span = self.spans[i]
        with np.errstate(over='ignore'):  # absurd pixels become infinite
            pixels, goal_pixels = (a[..., :2].astype(np.float32) for a in (objects, goals))
            measured = self.signal_names[i]
            signals = self.signals[rows, :len(measured)].astype(np.float32)
        return Episode(
            frames=self.frames(i), stamps=self.stamps[rows], actions=self.actions[rows],
            grippers=self.grippers[rows], object_names=tuple(names), object_source=source,
            object_pixels=pixels, object_poses=objects[..., 2:],
            goal_frame=None if goal_frame is None else goal_frame[0], goal_pixels=goal_pixels,
            goal_poses=goals[:, 2:], task=span.task, seed=span.seed, outcome=span.outcome or '',
            signal_names=measured, signals=signals if measured else None,
            robot_masks=self.pictures('mask', rows),
            goal_mask=None if goal_mask is None else goal_mask[0])
