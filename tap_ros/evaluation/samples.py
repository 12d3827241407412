# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the samples of a predictor with z are worth: the best of many, and how they differ."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.evaluation.bottleneck import context_pixels, known_maps
from tap_ros.evaluation.prediction import all_targets, draw_latents
from tap_ros.images.pixels import to_float
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.warp import expected_pixels, warp_object_maps
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.training.frames import FilledStore

SAMPLES = 100  # of the paper's last row of Table 1


@dataclass(frozen=True)
class SampleScores:
    """
    Measurements of the samples of N episodes.

    :param min_l1: (N,), the least error of any sample against any target.
    :param match_step: (N,), the time of that target.
    :param match_fraction: (N,), that time as a share of the episode.
    :param spread: (N,), standard deviation over the samples, on [0, 1], mean over the pixels.
    :param spread_px: (N,), how far from their mean the samples place an object: root mean square
        in pixels, mean over the objects; NaN with new pixels, which have no origin, or where
        positions are unknown.
    """

    min_l1: np.ndarray
    match_step: np.ndarray
    match_fraction: np.ndarray
    spread: np.ndarray
    spread_px: np.ndarray


def score_samples(network: PredictorNetwork, store: 'EpisodeStore', episodes: Iterable[int],
                  goal_picture: str = 'last', count: int = SAMPLES,
                  filled: 'FilledStore | None' = None) -> SampleScores:
    """
    Measure many samples of each episode.

    The first sample is the one that prediction.evaluate measures.

    :param network: PredictorNetwork with z, in eval mode.
    :param store: the EpisodeStore.
    :param episodes: indices of at least one episode.
    :param goal_picture: see batches.make_batch.
    :param count: samples of each episode.
    :param filled: as in prediction.evaluate.
    :return: SampleScores.
    """
    device = next(network.parameters()).device
    rows = []
    for i in episodes:
        batch = all_targets(network, store, [i], goal_picture, filled).to(device)
        z = draw_latents([i], count, network.config.latent_size)[0].to(device)
        with torch.inference_mode():
            prediction = network(to_float(batch.context).expand(count, -1, -1, -1, -1), z)
            errors = l1_errors(
                batch.visible(prediction.image[None]), batch.targets.movedim(-1, 2))[0]
            spread = (prediction.image.std(0, correction=0) / 2).mean().item()
            pixels, placed = context_pixels(store[i], goal_picture), np.nan
            if prediction.new_pixels is None and pixels.size and np.isfinite(pixels).all():
                bank, alike = network.bank, None
                if bank is not None:
                    (alike,), _ = bank.find(
                        batch.context.cpu().numpy(), network.config.num_keyframes)
                maps = known_maps(pixels, prediction, bank, alike).expand(count, -1, -1, -1, -1)
                at = expected_pixels(warp_object_maps(  # samples, K, 2
                    maps, prediction.flow, prediction.masks).maps)
                placed = ((at - at.mean(0)) ** 2).sum(-1).mean(0).sqrt().mean().item()
        errors = errors.amin(0, keepdim=True)  # the best sample for each target
        match = match_step(errors, batch.valid)
        step = batch.times[0, match].item()
        rows.append((errors[0, match].item(), step, step / batch.end.item(), spread, placed))
    return SampleScores(*(np.array(column) for column in zip(*rows)))
