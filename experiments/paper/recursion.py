# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where recursion leads (Eq. 3, Fig. 7): the prediction becomes the goal picture of the next."""

from dataclasses import dataclass

import numpy as np
from tap_ros.evaluation.bottleneck import MIN_MOTION
from tap_ros.evaluation.shown import ShownScorer
from tap_ros.images.pixels import to_float
from tap_ros.prediction.batches import make_batch, Sampling
from tap_ros.prediction.losses import l1_errors, match_step
import torch

LEVELS = 2
_BATCH = 64


@dataclass(frozen=True)
class LevelScores:
    """
    Measurements of the predictions of one level for N episodes.

    :param min_l1: (N,), error against the best matching frame between start and goal.
    :param match_step: (N,), the time of that frame.
    :param way: (N,), which share of their way the objects have behind them in that frame, 0 to 1;
        NaN where none moves MIN_MOTION pixels or positions are unknown.
    :param hand: (N,), how much of the hand is shown, see shown.ShownScorer; NaN where unknown.
    :param objects: (N,), likewise of the objects.
    """

    min_l1: np.ndarray
    match_step: np.ndarray
    way: np.ndarray
    hand: np.ndarray
    objects: np.ndarray


@torch.inference_mode()
def score_recursion(network, store, episodes, levels=LEVELS):
    """
    Measure the predictions of each level of recursion.

    :param network: Predictor in eval mode, without z, with start and goal as context.
    :param store: the EpisodeStore.
    :param episodes: indices of at least one episode, each of at least 3 frames.
    :param levels: how many; the first is the prediction itself.
    :return: list of LevelScores, the first level first.
    """
    device = next(network.parameters()).device
    rows = [[] for _ in range(levels)]
    for at in range(0, len(episodes), _BATCH):
        chosen = episodes[at:at + _BATCH]
        batch = make_batch(store, chosen, Sampling(goal_picture='last')).to(device)
        context = to_float(batch.context)
        scorers = [ShownScorer(store[i]) for i in chosen]
        for level in rows:
            image = network(context).image
            context = torch.stack([context[:, 0], image.clamp(-1, 1)], 1)
            errors = l1_errors(batch.visible(image[:, None]), batch.targets.movedim(-1, 2))[:, 0]
            match = match_step(errors, batch.valid)[:, None]
            times = batch.times.gather(1, match)[:, 0].tolist()
            pictures = ((image + 1) / 2).movedim(1, -1).cpu().numpy()
            level.extend(
                (error, time, way_behind(store[i].object_pixels, time),
                 *scorer.score(picture, time)) for i, error, time, scorer, picture in zip(
                    chosen, errors.gather(1, match)[:, 0].tolist(), times, scorers, pictures))
    return [LevelScores(*map(np.array, zip(*level))) for level in rows]


def way_behind(pixels, time):
    """
    Say which share of their way the moved objects of an episode have behind them.

    :param pixels: (T, K, 2), (u, v) of the objects; NaN where unknown.
    :param time: number of a frame.
    :return: float 0..1, the mean over the objects that move; NaN where none does.
    """
    way = np.linalg.norm(pixels[-1] - pixels[0], axis=-1)
    behind = np.linalg.norm(pixels[time] - pixels[0], axis=-1)[way >= MIN_MOTION]
    moved = np.minimum(behind / way[way >= MIN_MOTION], 1)
    return float(moved.mean()) if len(moved) else np.nan
