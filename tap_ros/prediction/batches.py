# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Training batches from recorded episodes.

A batch depends on nothing but the episodes, the seed and the step: training that is interrupted
and resumed sees the same ones.
"""

from dataclasses import dataclass
import zlib

import numpy as np
from tap_ros.errors import RecordingError
import torch

REACHED = 2.0  # px


@dataclass(frozen=True)
class Batch:
    """
    Context pictures and the frames between them, of B episodes.

    :param context: uint8 (B, 2, H, W, 3), start and goal.
    :param targets: uint8 (B, T, H, W, 3), zeros where padded.
    :param times: int64 (B, T), when each target was seen; the start picture is time 0.
    :param first: int64 (B, 1), the earliest time a target of this episode could have.
    :param last: int64 (B, 1), the latest.
    :param end: int64 (B, 1), the time of the goal picture.
    :param valid: bool (B, T), False where padded.
    """

    context: torch.Tensor
    targets: torch.Tensor
    times: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    end: torch.Tensor
    valid: torch.Tensor

    def to(self, device):
        """Copy everything to a device."""
        return Batch(**{name: tensor.to(device, non_blocking=True)
                        for name, tensor in vars(self).items()})


def split_episodes(store, test_fraction, min_frames=3):
    """
    Split episodes into training and held-out ones, by task and seed.

    Episodes of the same scene land on the same side, whichever recording they are in.
    Recordings without seeds are split by position.

    :param store: the EpisodeStore.
    :param test_fraction: the held-out share, 0..1.
    :param min_frames: episodes with fewer frames are left out.
    :return: (training, held-out), int64 arrays of episode indices.
    :raises RecordingError: if no episode is long enough to train on.
    """
    usable = [i for i in range(len(store)) if store.lengths[i] >= min_frames]
    if not usable:
        raise RecordingError(f'recordings: no episode has at least {min_frames} frames; '
                             'record longer ones')
    keys = [(store[i].task, store[i].seed) for i in usable]
    if len(set(keys)) == 1:
        keys = usable
    # A hash rather than a random draw: adding episodes moves none to the other side.
    held = np.array([zlib.crc32(repr(key).encode()) < test_fraction * 2 ** 32 for key in keys])
    usable = np.array(usable)
    if held.all():
        held[0] = False
    return usable[~held], usable[held]


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


def target_times(end, margin):
    """
    Say at which times an episode's targets lie (T of Eq. 2).

    :param end: time of the goal picture, at least 2.
    :param margin: frames to leave out next to each context picture; less in short episodes, so
        that one target remains at least.
    :return: (first, last), both included.
    """
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


def make_batch(store, episodes, margin=0, num_targets=0, middle=False, max_frames=0,
               min_crop=1.0, goal_picture='last', rng=None):
    """
    Gather context pictures and targets.

    :param store: the EpisodeStore.
    :param episodes: indices of B episodes.
    :param margin: frames left out next to each context picture.
    :param num_targets: at most so many targets, drawn at random without repetition; 0: all.
    :param middle: take only the middle frame, as fixed-time prediction does.
    :param max_frames: longer episodes are cut to a random piece of this many; 0: never.
    :param min_crop: cut episodes to a random piece of at least this share; 1: never.
    :param goal_picture: see uses_recorded_goal.
    :param rng: numpy Generator; needed only where something is drawn.
    :return: Batch.
    """
    rng = rng or np.random.default_rng(0)
    rows = []
    for i in episodes:
        episode = store[i]
        frames = episode.frames
        length = len(frames)
        if min_crop < 1:
            length = max(3, round(length * rng.uniform(min_crop, 1)))
        if max_frames:
            length = min(length, max_frames)
        start = rng.integers(len(frames) - length + 1) if length < len(frames) else 0
        end = length - 1
        first, last = target_times(end, margin)
        times = np.arange(first, last + 1)
        if middle:
            times = np.array([(end + 1) // 2])
        elif num_targets and len(times) > num_targets:
            times = np.sort(rng.choice(times, num_targets, replace=False))
        goal = frames[start + end]
        if (uses_recorded_goal(episode, goal_picture, rng)
                and start + length == len(frames)):
            goal = episode.goal_frame
        rows.append((frames[start], goal, frames[start + times], times, first, last, end))
    B, T = len(rows), max(len(row[3]) for row in rows)
    H, W = rows[0][0].shape[:2]
    context = np.empty((B, 2, H, W, 3), np.uint8)
    targets = np.zeros((B, T, H, W, 3), np.uint8)
    times = np.zeros((B, T), np.int64)
    valid = np.zeros((B, T), bool)
    for b, (start, goal, frames, at, *_) in enumerate(rows):
        context[b, 0], context[b, 1] = start, goal
        targets[b, :len(at)], times[b, :len(at)], valid[b, :len(at)] = frames, at, True
    bounds = np.array([row[4:] for row in rows], np.int64)[:, :, None]  # B, 3, 1
    return Batch(*(torch.from_numpy(array) for array in (
        context, targets, times, bounds[:, 0], bounds[:, 1], bounds[:, 2], valid)))
