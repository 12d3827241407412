# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the planner minimises, term by term, in pixels."""

from collections.abc import Iterable

import numpy as np
from tap_ros.planning.action_sequences import HORIZON
import torch

NEAR = 3.0  # px; an object nearer to its goal is finished
LAST_WEIGHT = 10.0  # of the horizon's last step, as the authors' planner has; the others have 1


def prices(distances: torch.Tensor, unfinished: float) -> torch.Tensor:
    """
    Say what an object costs in every place: its distance, and more while it is not finished.

    :param distances: (K, C) px, of each place to each goal.
    :param unfinished: px, what an object costs more beyond NEAR, less and less within it.
    :return: (K, C) px.
    """
    return distances + unfinished * (distances / NEAR).clamp(max=1)


def cost_of_maps(carried: Iterable[torch.Tensor],
                 prices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Sum what the objects are expected to cost, over objects and over the horizon.

    :param carried: iterable of maps (N, K, n, n) after equal numbers of steps, the last one at the
        horizon's end; those that were left out count like the ones before the last. Mass that is
        lost costs as much as in the dearest place.
    :param prices: (K, n n) px, of an object in each cell.
    :return: costs (N,) px; price at the horizon's end (N,), px, mean over objects.
    """
    worst, total, seen = prices.amax(1), 0, 0
    for maps in carried:
        maps = maps.flatten(2)
        last = torch.einsum('nkc,kc->nk', maps, prices)
        last = last + (1 - maps.sum(2)) * worst
        total, seen = total + last.sum(1), seen + 1
    before = (total - last.sum(1)) * (HORIZON - 1) / max(1, seen - 1)
    return before + LAST_WEIGHT * last.sum(1), last.mean(1)


def landing_clash(landings: np.ndarray, objects: np.ndarray, clearance: float) -> np.ndarray:
    """
    Cost of coming down upon an object, which recordings of good pushes do not show.

    :param landings: (N, 2) metres, NaN for none; objects: (K, 2); clearance: m.
    :return: (N,) pixels: 0, or 100 and 10 for every centimetre that is missing.
    """
    if not clearance:
        return np.zeros(len(landings))
    gap = np.linalg.norm(landings[:, None] - objects, axis=-1).min(1)  # (N,)
    return np.where(gap < clearance, 100 + 1000 * (clearance - gap), 0)
