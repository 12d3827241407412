# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether a prediction is a bottleneck: some objects at their goals, others in place (app. E).

Object positions are the recordings', that is, the simulator's ground truth; they score only.
"""

from collections.abc import Callable, Sequence
from itertools import product
from typing import TypeAlias

import numpy as np
from tap_ros.planning.cost import distances_to_pixels
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.networks import Prediction
from tap_ros.prediction.warp import one_hot_maps, warp_object_maps, WarpedMaps
from tap_ros.recording.episode import Episode
from tap_ros.training.batches import uses_recorded_goal
import torch

THRESHOLDS = tuple(range(11))  # px
# An object that hardly moves is at its start and its goal at once: a bottleneck for free.
MIN_MOTION = 4.0  # px
# A map is normalised, so an object that a prediction leaves out is still somewhere by its map.
VISIBLE = 0.5  # least mass, of 1, that the maps of all objects keep if these are to be seen
MapsOf: TypeAlias = Callable[[int, np.ndarray], WarpedMaps]


def bottleneck_scores(maps: torch.Tensor, start_pixels: torch.Tensor,
                      goal_pixels: torch.Tensor) -> torch.Tensor:
    """
    Score how near a prediction is to some objects at their goals and the others at their starts.

    Appendix E: the smaller one of two hypotheses, which object moves first; each is the sum over
    both objects of the expected distance. With three objects, which is not in the paper, there
    are six: one of them moved, or two.

    :param maps: (B, K, H, W), object maps of the predictions.
    :param start_pixels: (B, K, 2), (u, v) of the objects in the start picture.
    :param goal_pixels: (B, K, 2), in the goal picture.
    :return: (B,), in pixels.
    """
    return least_sum(*(distances_to_pixels(maps, pixels) for pixels in (
        start_pixels, goal_pixels)))


def least_sum(to_start: torch.Tensor, to_goal: torch.Tensor) -> torch.Tensor:
    """Return (B,), the least sum of distances (B, K) with some objects moved, but not all."""
    halfway = list(product((False, True), repeat=to_start.shape[1]))[1:-1]
    scores = [torch.where(torch.tensor(moved, device=to_start.device), to_goal, to_start).sum(1)
              for moved in halfway]
    return torch.stack(scores).amin(0)


def context_pixels(episode: Episode, goal_picture: str) -> np.ndarray:
    """
    Find the objects of an episode at its start and its goal.

    :param episode: the Episode.
    :param goal_picture: see batches.uses_recorded_goal.
    :return: float32 (2, K, 2), (u, v); NaN where unknown.
    """
    goal = episode.object_pixels[-1]
    if uses_recorded_goal(episode, goal_picture):
        goal = episode.goal_pixels
    return np.stack([episode.object_pixels[0], goal]).astype(np.float32)


def known_maps(pixels: np.ndarray, prediction: Prediction, bank: KeyframeBank | None,
               alike: np.ndarray | None = None) -> torch.Tensor:
    """
    Return one-hot maps (1, C, K, H, W) of the objects in the pictures that are copied from.

    :param pixels: float32 (2, K, 2), of context_pixels; a forward prediction uses the start only.
    :param bank: that other pictures are from, of demonstrations `alike` (n,); None: there is none.
    """
    flow = prediction.flow
    maps = one_hot_maps(
        torch.from_numpy(pixels[:flow.shape[1]]).to(flow.device), flow.shape[-2:])[None]
    return maps if bank is None or alike is None else bank.beside_maps(
        maps, pixels[:1], alike[None])


def predicted_maps(pixels: np.ndarray, prediction: Prediction, b: int,
                   bank: KeyframeBank | None = None,
                   alike: np.ndarray | None = None) -> WarpedMaps:
    """
    Warp one-hot maps of the objects as a prediction warps its context pictures.

    :param pixels: float32 (2, K, 2), of context_pixels; bank, alike: as known_maps takes them.
    :param prediction: networks.Prediction of a batch.
    :param b: which one of the batch.
    :return: warp.WarpedMaps of (K, H, W) maps, each sums to 1, and (K,) masses.
    """
    warped = warp_object_maps(known_maps(pixels, prediction, bank, alike),
                              prediction.flow[b:b + 1], prediction.masks[b:b + 1])
    return WarpedMaps(warped.maps[0], warped.mass[0])


def can_be_bottleneck(pixels: np.ndarray) -> bool:
    """Return whether there are two objects or more, known and moved; pixels (2, K, 2)."""
    return bool(pixels.shape[1] >= 2 and np.isfinite(pixels).all() and (
        np.linalg.norm(pixels[1] - pixels[0], axis=-1).min() >= MIN_MOTION))


def score_bottlenecks(episodes: Sequence[Episode], maps_of: MapsOf,
                      goal_picture: str) -> tuple[np.ndarray, np.ndarray]:
    """
    Score the predictions of a batch, and copying the start or the goal instead.

    :param episodes: list of B Episodes.
    :param maps_of: gives the maps of the prediction for an episode, from its number and the
        pixels (2, K, 2) of its objects, see predicted_maps.
    :param goal_picture: see batches.uses_recorded_goal.
    :return: float32 (B, 3), prediction, copy-start, copy-goal, in pixels, and float32 (B, 3), the
        mass that the map of that object has kept which lost most, of 1. NaN where it is
        undefined: for fewer than two objects, unknown positions, or an object that stays.
    """
    result = np.full((len(episodes), 3), np.nan, np.float32)
    mass = result.copy()
    for b, episode in enumerate(episodes):
        pixels = context_pixels(episode, goal_picture)
        if not can_be_bottleneck(pixels):
            continue
        warped = maps_of(b, pixels)
        pixels = torch.from_numpy(pixels).to(warped.maps.device)
        maps = torch.cat([  # of the prediction, the start and the goal
            warped.maps[None], one_hot_maps(pixels, warped.maps.shape[-2:])])
        result[b] = bottleneck_scores(maps, pixels[:1], pixels[1:]).cpu().numpy()
        mass[b] = warped.mass.min().item(), 1, 1
    return result, mass
