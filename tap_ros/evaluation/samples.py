# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the samples of a predictor with z are worth: the best of many, and how they differ."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.evaluation.bottleneck import context_pixels
from tap_ros.images.pixels import to_float
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.networks import Prediction, PredictorNetwork
from tap_ros.prediction.warp import expected_pixels, one_hot_maps, warp_object_maps
from tap_ros.training.batches import make_batch, Pictures, Sampling
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.training.frames import FilledStore

NEAR = 6.0  # px

SAMPLES = 100  # of the paper's last row of Table 1


@dataclass(frozen=True)
class SampleScores:
    """
    Measurements of the samples of N episodes.

    :param min_l1: (N,), the least error of any sample against any target.
    :param match_step: (N,), the time of that target.
    :param match_fraction: (N,), that time as a share of the episode.
    :param spread: (N,), standard deviation over the samples, on [0, 1], mean over the pixels.
    :param spread_near: (N,), the same over the pixels within NEAR of where an object starts or
        ends; NaN where that is unknown.
    :param spread_elsewhere: (N,), over the others.
    :param spread_px: (N,), how far from their mean the samples place an object: root mean square
        in pixels, mean over the objects; NaN with new pixels, which have no origin, or where
        positions are unknown.
    """

    min_l1: np.ndarray
    match_step: np.ndarray
    match_fraction: np.ndarray
    spread: np.ndarray
    spread_near: np.ndarray
    spread_elsewhere: np.ndarray
    spread_px: np.ndarray


def draw_latents(episodes: Iterable[int], count: int, size: int) -> torch.Tensor:
    """
    Draw z from the prior, for each episode its own, whichever others are asked for.

    :param episodes: (B,) indices of episodes.
    :param count: samples of each; fewer are the first ones of more.
    :param size: length of z.
    :return: float32 (B, count, size).
    """
    return torch.from_numpy(np.stack([
        np.random.default_rng([0, int(i)]).standard_normal((count, size), np.float32)
        for i in episodes]))


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
        batch = make_batch(store, [i], Sampling(
            goal_picture=goal_picture,
            forward=network.config.num_context == 1),
            pictures=Pictures(filled=filled)).to(device)
        z = draw_latents([i], count, network.config.latent_size)[0].to(device)
        with torch.inference_mode():
            prediction = network(to_float(batch.context).expand(count, -1, -1, -1, -1), z)
            errors = l1_errors(
                batch.visible(prediction.image[None]), batch.targets.movedim(-1, 2))[0]
            pixels = context_pixels(store[i], goal_picture)
            spread = (prediction.image.std(0, correction=0) / 2).mean(0).cpu()  # H, W
            placed = _spread_px(prediction, pixels)
        near = _near(pixels, spread.shape)
        spreads = [part.mean().item() if part.numel() else np.nan
                   for part in (spread, spread[near], spread[~near if near.any() else near])]
        errors = errors.amin(0, keepdim=True)  # the best sample for each target
        match = match_step(errors, batch.valid)
        step = batch.times[0, match].item()
        rows.append((errors[0, match].item(), step, step / batch.end.item(), *spreads, placed))
    return SampleScores(*(np.array(column) for column in zip(*rows)))


def _near(pixels: np.ndarray, size: Sequence[int]) -> torch.Tensor:
    """Mark the pixels near an object in a context picture; pixels (2, K, 2), bool (H, W)."""
    v, u = np.indices(size)
    at = pixels.reshape(-1, 2)
    at = at[np.isfinite(at).all(1)]
    return torch.from_numpy((np.hypot(u - at[:, 0, None, None], v - at[:, 1, None, None])
                             <= NEAR).any(0))


def _spread_px(prediction: Prediction, pixels: np.ndarray) -> float:
    """Measure how differently the samples of one episode place its objects."""
    if prediction.new_pixels is not None or not pixels.size or not np.isfinite(pixels).all():
        return np.nan
    flow, masks = prediction.flow, prediction.masks
    pixels = torch.from_numpy(pixels[:flow.shape[1]]).to(flow.device)
    maps = one_hot_maps(pixels, flow.shape[-2:]).expand(len(flow), -1, -1, -1, -1)
    at = expected_pixels(warp_object_maps(maps, flow, masks).maps)  # samples, K, 2
    return ((at - at.mean(0)) ** 2).sum(-1).mean(0).sqrt().mean().item()
