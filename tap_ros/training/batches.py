# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Training batches from recorded episodes.

A batch depends on nothing but the episodes, the seed and the step: training that is interrupted
and resumed sees the same ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.training.augmentation import Augmentation
from tap_ros.training.frames import FilledStore, Frames, gather, GOAL
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.recording.episode import Episode
    from tap_ros.training.keyframes import Keyframes

REACHED = 2.0  # px


@dataclass(frozen=True)
class Batch:
    """
    Context pictures and the frames to predict, of B episodes.

    :param context: uint8 (B, C, H, W, 3): start and goal, or in forward prediction the start.
    :param targets: uint8 (B, T, H, W, 3); some frame where padded.
    :param times: int64 (B, T), when each target was seen; the start picture is time 0.
    :param first: int64 (B, 1), the earliest time a target of this episode could have.
    :param last: int64 (B, 1), the latest.
    :param end: int64 (B, 1), the time of the goal picture.
    :param valid: bool (B, T), False where padded.
    :param video: uint8 (B, N, H, W, 3), the episode from start to goal at N moments at equal
        distances; None unless asked for.
    :param bare: uint8 (B, 1 or 2, H, W, 3), start and goal as errors are measured with them:
        without the robot, filled as targets and video are then; None: the context itself.
    :param seen: bool (B, H, W), False where the robot hides a pixel that is never free. There
        targets, video and bare are black, and nothing counts; None: True everywhere.
    :param preference: float32 (B, levels, T), w(t) of Eq. 5 for selection marks and still, of each
        level of recursion; else None.
    :param keyframes: uint8 (B, levels, n, H, W, 3), pictures beside start and goal of each level
        of recursion; None: networks see two.
    :param augmentation: of all pictures that networks see; None: they see them as they are.
    """

    context: torch.Tensor
    targets: torch.Tensor
    times: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    end: torch.Tensor
    valid: torch.Tensor
    video: torch.Tensor | None = None
    bare: torch.Tensor | None = None
    seen: torch.Tensor | None = None
    preference: torch.Tensor | None = None
    keyframes: torch.Tensor | None = None
    augmentation: Augmentation | None = None

    @property
    def measured(self) -> torch.Tensor:
        """The context pictures as errors are measured with them: filled if targets are."""
        return self.context if self.bare is None else self.bare

    def visible(self, images: torch.Tensor) -> torch.Tensor:
        """
        Return pictures (B, N, 3, H, W) in [-1, 1], black where targets are.

        So these pixels add neither to an error nor to a gradient.
        """
        return images if self.seen is None else images.masked_fill(
            ~self.seen[:, None, None], -1)

    def to(self, device: torch.device | str) -> 'Batch':
        """Copy everything to a device."""
        return Batch(**{name: value.to(device, non_blocking=True)
                        for name, value in vars(self).items() if value is not None})


@dataclass(frozen=True)
class Sampling:
    """
    What is taken from an episode; what is not told here, see predictor_config.TrainingConfig.

    :param forward: whether the start picture is all of the context.
    :param around: frames on each side of the largest preferences that stay between start and
        goal, which are drawn before and after: the ends of the episode in half of the cases. 0:
        the ends, as the crops leave them.
    :param fraction: take only the frame at this share of the episode, 0 to 1, as fixed-time
        prediction does; None: all.
    :param num_others: with a fraction, so many random other targets after that one.
    :param video_frames: length of Batch.video; 0: none.
    """

    margin: int = 0
    num_targets: int = 0
    min_crop: float = 1.0
    start_crop: float = 0.0
    goal_picture: str = 'last'
    forward: bool = False
    around: int = 0
    fraction: float | None = None
    num_others: int = 0
    video_frames: int = 0
    fill_context: float = 0.0


def episode_order(num_episodes: int, batch_size: int, seed: int, step: int) -> np.ndarray:
    """
    Say which episodes the batch of a step has, int64 (B,): shuffled passes over all of them.

    :param num_episodes: how many there are.
    :param seed: of the training run; step: number of the step.
    """
    at = np.arange(step * batch_size, (step + 1) * batch_size)
    orders = {epoch: np.random.default_rng([seed, 1, epoch]).permutation(num_episodes)
              for epoch in np.unique(at // num_episodes)}
    return np.array([orders[i // num_episodes][i % num_episodes] for i in at])


def target_times(end: int, margin: int, forward: bool = False) -> tuple[int, int]:
    """
    Say at which times an episode's targets lie (T of Eq. 2).

    :param end: time of the last frame, at least 2.
    :param margin: frames to leave out next to each context picture; less in short episodes, so
        that one target remains at least.
    :param forward: whether there is no goal picture: then the last frame is a target too.
    :return: (first, last), both included.
    """
    if forward:
        return 1 + min(margin, end - 1), end
    margin = min(margin, (end - 2) // 2)
    return 1 + margin, end - 1 - margin


def uses_recorded_goal(episode: 'Episode', goal_picture: str,
                       rng: np.random.Generator | None = None) -> bool:
    """
    Return whether an episode's goal picture is the goal's own rather than its last frame.

    In the last frame the arm stands beside the object that was pushed last, in the goal's own
    picture it does not.

    :param goal_picture: 'last'; 'recorded': the goal's own picture where it was reached;
        'mixed': that in half of the cases. Reached means that every object ends within
        REACHED pixels of its goal; where positions are unknown, that the outcome says success.
    :param rng: numpy Generator, drawn from for 'mixed'.
    :return: bool.
    """
    if goal_picture == 'mixed':
        assert rng is not None, 'what is mixed is drawn'
        if rng.random() < 0.5:
            return False
    if goal_picture == 'last' or episode.goal_frame is None:
        return False
    away = np.linalg.norm(episode.object_pixels[-1] - episode.goal_pixels, axis=-1)
    if len(away) and np.isfinite(away).all():
        return bool(away.max() <= REACHED)
    return episode.outcome == 'success'


def fixed_time(fraction: float, end: int, first: int, last: int) -> int:
    """Return the time, first to last, at a share of an episode that ends at time `end`."""
    return int(np.clip(int(fraction * end + 0.5), first, last))


@dataclass(frozen=True)
class Pictures:
    """
    Where the pictures of a batch come from, and what is known of them.

    :param frames: where they come from; None: the store.
    :param filled: with a robot mask, where targets and video come from.
    :param preference: of every episode of the store w of its frames, (levels, T).
    :param keyframes: what pictures beside start and goal are drawn from.
    """

    frames: Frames | None = None
    filled: FilledStore | None = None
    preference: Sequence[np.ndarray] | None = None
    keyframes: 'Keyframes | None' = None


def make_batch(store: 'EpisodeStore', episodes: Sequence[int] | np.ndarray,
               sampling: Sampling = Sampling(), rng: np.random.Generator | None = None,
               pictures: Pictures = Pictures()) -> Batch:
    """
    Gather context pictures and targets.

    :param episodes: indices of B episodes.
    :param sampling: by default all frames between the first and the last.
    :param rng: numpy Generator; needed only where something is drawn.
    :return: Batch, without augmentation.
    """
    rng = rng or np.random.default_rng(0)
    rows = [_choose(store, i, sampling, rng, None if pictures.preference is None
                    else pictures.preference[i]) for i in episodes]
    T = max(len(row.times) for row in rows)
    times = np.stack([np.pad(row.times, (0, T - len(row.times))) for row in rows])
    valid = torch.arange(T) < torch.tensor([[len(row.times)] for row in rows])
    context, video, bounds, starts = (np.array([getattr(row, name) for row in rows])
                                      for name in ('context', 'video', 'bounds', 'start'))
    shown = starts[:, None] + times
    frames, filled = pictures.frames or partial(gather, store), pictures.filled
    first, last, end = torch.from_numpy(bounds).split(1, dim=1)
    free, preference = filled.gather if filled else frames, pictures.preference
    batch = Batch(
        frames(episodes, context), free(episodes, shown), torch.from_numpy(times),
        first, last, end, valid,
        free(episodes, video) if sampling.video_frames else None,
        preference=None if preference is None else torch.from_numpy(np.stack(
            [preference[i][:, at] for i, at in zip(episodes, shown)])))
    if filled is None:
        return batch
    bare = free(episodes, context)
    chosen = torch.tensor([row.filled for row in rows], device=bare.device)
    seen = torch.from_numpy(filled.seen[np.asarray(episodes)]).to(bare.device)
    context = torch.where(chosen[:, None, None, None, None], bare, batch.context)
    for pictures_there in (batch.targets, batch.video, bare):
        if pictures_there is not None:
            pictures_there.masked_fill_(~seen[:, None, ..., None], 0)
    return replace(batch, seen=seen, bare=bare, context=context)


@dataclass(frozen=True)
class _Row:
    """What is taken from one episode: frame numbers, and times from `start` on."""

    start: int
    context: list[int]  # frame numbers, or GOAL
    video: np.ndarray  # the same
    times: np.ndarray  # of the targets
    bounds: tuple[int, int, int]  # first and last time that a target could have, time of the goal
    filled: bool  # whether the context pictures are without the robot


def _choose(store: 'EpisodeStore', i: int, sampling: Sampling, rng: np.random.Generator,
            preference: np.ndarray | None) -> _Row:
    """Choose a piece of episode i, and its targets; preference: (levels, T), w of its frames."""
    available = length = int(store.lengths[i])
    if sampling.min_crop < 1:
        length = max(3, round(length * rng.uniform(sampling.min_crop, 1)))
    start = int(rng.integers(available - length + 1)) if length < available else 0
    if sampling.start_crop:
        late = min(int(rng.uniform(0, sampling.start_crop) * length), length - 3)
        start, length = start + late, length - late
    if sampling.around and preference is not None:
        labels = preference.argmax(1)
        earliest, latest = labels.min() - sampling.around, labels.max() + sampling.around
        start, stop = (int(rng.integers(low, max(low, high) + 1)) if rng.random() < 0.5 else usual
                       for low, high, usual in ((0, earliest, 0), (
                           min(latest, length - 1), length - 1, length - 1)))
        length = stop - start + 1
    end, goal = length - 1, start + length - 1
    first, last = target_times(end, sampling.margin, sampling.forward)
    times = np.arange(first, last + 1)
    if sampling.fraction is not None:
        fixed = fixed_time(sampling.fraction, end, first, last)
        others = rng.permutation(times[times != fixed])[:sampling.num_others]
        times = np.append(fixed, others if len(others) or not sampling.num_others else fixed)
    elif sampling.num_targets and len(times) > sampling.num_targets:
        times = np.sort(rng.choice(times, sampling.num_targets, replace=False))
    if (sampling.goal_picture != 'last'
            and uses_recorded_goal(store[i], sampling.goal_picture, rng)
            and start + length == available):
        goal = GOAL
    context = [start] if sampling.forward else [start, goal]
    video = start + np.rint(np.linspace(0, end, sampling.video_frames)).astype(int)
    video[video == start + end] = goal
    filled = sampling.fill_context > 0 and rng.random() < sampling.fill_context
    return _Row(start, context, video, times, (first, last, end), filled)
