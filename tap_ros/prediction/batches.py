# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Training batches from recorded episodes.

A batch depends on nothing but the episodes, the seed and the step: training that is interrupted
and resumed sees the same ones.
"""

from dataclasses import dataclass

import numpy as np
from tap_ros.learning.frames import GOAL, MappedFrames
import torch

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
    """

    context: torch.Tensor
    targets: torch.Tensor
    times: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    end: torch.Tensor
    valid: torch.Tensor
    video: torch.Tensor | None = None

    def to(self, device):
        """Copy everything to a device."""
        return Batch(**{name: tensor.to(device, non_blocking=True)
                        for name, tensor in vars(self).items() if tensor is not None})


def episode_order(num_episodes, batch_size, seed, step):
    """
    Say which episodes the batch of a step has: shuffled passes over all of them.

    :param num_episodes: how many there are.
    :param batch_size: B.
    :param seed: of the training run.
    :param step: number of the step.
    :return: int64 (B,), positions among the episodes.
    """
    at = np.arange(step * batch_size, (step + 1) * batch_size)
    orders = {epoch: np.random.default_rng([seed, 1, epoch]).permutation(num_episodes)
              for epoch in np.unique(at // num_episodes)}
    return np.array([orders[i // num_episodes][i % num_episodes] for i in at])


def target_times(end, margin, forward=False):
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


def uses_recorded_goal(episode, goal_picture, rng=None):
    """
    Say whether an episode's goal picture is the goal's own rather than its last frame.

    In the last frame the arm stands beside the object that was pushed last, in the goal's own
    picture it does not.

    :param episode: the Episode.
    :param goal_picture: 'last'; 'recorded': the goal's own picture where it was reached;
        'mixed': that in half of the cases. Reached means that every object ends within
        REACHED pixels of its goal; where positions are unknown, that the outcome says success.
    :param rng: numpy Generator, drawn from for 'mixed'.
    :return: bool.
    """
    if goal_picture == 'mixed' and rng.random() < 0.5:
        return False
    if goal_picture == 'last' or episode.goal_frame is None:
        return False
    away = np.linalg.norm(episode.object_pixels[-1] - episode.goal_pixels, axis=-1)
    if len(away) and np.isfinite(away).all():
        return bool(away.max() <= REACHED)
    return episode.outcome == 'success'


def fixed_time(fraction, end, first, last):
    """Return the time, first to last, at a share of an episode that ends at time `end`."""
    return int(np.clip(int(fraction * end + 0.5), first, last))


def make_batch(store, episodes, margin=0, num_targets=0, fraction=None, max_frames=0,
               min_crop=1.0, goal_picture='last', forward=False, num_others=0, video_frames=0,
               frames=None, rng=None):
    """
    Gather context pictures and targets.

    :param store: the EpisodeStore.
    :param episodes: indices of B episodes.
    :param margin: frames left out next to each context picture.
    :param num_targets: at most so many targets, drawn at random without repetition; 0: all.
    :param fraction: take only the frame at this share of the episode, 0 to 1, as fixed-time
        prediction does; None: all.
    :param max_frames: longer episodes are cut to a random piece of this many; 0: never.
    :param min_crop: cut episodes to a random piece of at least this share; 1: never.
    :param goal_picture: see uses_recorded_goal.
    :param forward: whether the start picture is all of the context.
    :param num_others: with a fraction, so many random other targets after that one.
    :param video_frames: length of Batch.video; 0: none.
    :param frames: where the pictures come from, see frames.py; None: the store.
    :param rng: numpy Generator; needed only where something is drawn.
    :return: Batch.
    """
    rng = rng or np.random.default_rng(0)
    rows = []
    for i in episodes:
        available = length = int(store.lengths[i])
        if min_crop < 1:
            length = max(3, round(length * rng.uniform(min_crop, 1)))
        if max_frames:
            length = min(length, max_frames)
        start = rng.integers(available - length + 1) if length < available else 0
        end = length - 1
        first, last = target_times(end, margin, forward)
        times = np.arange(first, last + 1)
        if fraction is not None:
            fixed = fixed_time(fraction, end, first, last)
            others = rng.permutation(times[times != fixed])[:num_others]
            times = np.append(fixed, others if len(others) or not num_others else fixed)
        elif num_targets and len(times) > num_targets:
            times = np.sort(rng.choice(times, num_targets, replace=False))
        goal = start + end
        if (goal_picture != 'last' and uses_recorded_goal(store[i], goal_picture, rng)
                and start + length == available):
            goal = GOAL
        context = [start] if forward else [start, goal]
        video = start + np.rint(np.linspace(0, end, video_frames)).astype(int)
        video[video == start + end] = goal
        rows.append((context, video, start, times, first, last, end))
    B, T = len(rows), max(len(row[3]) for row in rows)
    times, shown = np.zeros((B, T), np.int64), np.zeros((B, T), np.int64)
    valid = np.zeros((B, T), bool)
    for b, (_, _, start, at, *_) in enumerate(rows):
        times[b, :len(at)], valid[b, :len(at)] = at, True
        shown[b] = start + times[b]
    bounds = np.array([row[4:] for row in rows], np.int64)[:, :, None]  # B, 3, 1
    context, video = (np.array([row[k] for row in rows]) for k in (0, 1))
    frames = frames or MappedFrames(store)
    return Batch(
        frames(episodes, context), frames(episodes, shown),
        *(torch.from_numpy(array) for array in (
            times, bounds[:, 0], bounds[:, 1], bounds[:, 2], valid)),
        frames(episodes, video) if video_frames else None)
