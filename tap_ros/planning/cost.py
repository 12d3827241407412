# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the planner minimises, in pixels; the forward model knows none of it.

The expected distance E_q|x - y| is how far an object under a map q is from a place x, the mean
over y. It comes for one place of each map, for any number of places, and for all pixels. The first
is exact; the others are fast, and off by rounding: at most 0.05 px.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from tap_ros.planning.action_sequences import FULL, HORIZON, Limits
from tap_ros.planning.table import pixel_points
import torch

NEAR = 3.0  # px; an object nearer to its goal is finished
BLOCKED = 0.06  # m around where the 4 cm of the gripper met something; a bar is about as wide
LEG = 0.02  # m beyond the clearance that the legs of an object may reach
EDGE = 0.01  # m to the edge of the workspace from what is at it
LAST_WEIGHT = 10.0  # of the horizon's last step, as the authors' planner has; the others have 1


@dataclass(frozen=True)
class PlanCost:
    """
    The planner's cost; give VisualMPC another one with the same methods to minimise that.

    :param unfinished: px, what an object costs more beyond NEAR, less and less within it.
    :param clearance: m from any object to where the gripper may come down; 0: anywhere.
    """

    unfinished: float = 0.0
    clearance: float = 0.0

    def prices(self, distances: torch.Tensor) -> torch.Tensor:
        """Return what an object costs in every place, from its distances (K, C) to its goal."""
        return distances + self.unfinished * (distances / NEAR).clamp(max=1)

    def of_maps(self, carried: Iterable[torch.Tensor],
                prices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Sum what the objects are expected to cost, over objects and over the horizon.

        :param carried: iterable of maps (N, K, n, n) after equal numbers of steps, the last one at
            the horizon's end; those that were left out count like the ones before the last. Mass
            that is lost costs as much as in the dearest place.
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

    def of_landings(self, landings: np.ndarray, objects: np.ndarray, blocked: np.ndarray,
                    limits: Limits = FULL) -> np.ndarray:
        """
        Cost of coming down upon an object, which recordings of good pushes do not show.

        :param landings: (N, 2) metres, NaN for none; objects: (K, 2).
        :param blocked: (B, 2), where the gripper met something; dearer than any push gains.
        :param limits: of the arm: where its workspace ends.
        :return: (N,) pixels: 0, or 100 (1000 where blocked or out of the workspace) and 10 for
            every centimetre that is missing; the latter alone within LEG of the clearance, and
            where the workspace ends: nothing is farther there, so narrow places are tried.
        """
        low, high = np.array(limits.low), np.array(limits.high)
        out, edge = (((landings < low + margin) | (landings > high - margin)).any(1)
                     for margin in (-1e-3, EDGE))
        costs = np.where(out, 1000.0, 0.0)
        if self.clearance:
            for places, near, least, room in (
                    (objects, np.where(edge, BLOCKED, self.clearance), 100, self.clearance + LEG),
                    (blocked, BLOCKED, 1000, BLOCKED)):
                gap = np.linalg.norm(landings[:, None] - places, axis=-1).min(1, initial=np.inf)
                costs += np.where(gap < near, least, 0) + 1000 * np.fmax(room - gap, 0)
        return costs


def distances_to_pixels(maps: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """
    Compute the expected distance (...), in pixels, of each map to a place of its own.

    :param maps: (..., H, W), each sums to 1; pixels: (..., 2), (u, v).
    """
    H, W = maps.shape[-2:]
    u = torch.arange(W, device=maps.device) - pixels[..., 0, None, None]
    v = torch.arange(H, device=maps.device)[:, None] - pixels[..., 1, None, None]
    return (maps * torch.sqrt(u ** 2 + v ** 2)).sum((-2, -1))


def distances_to_places(maps: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """
    Compute the expected distance (K, N), in pixels, of each map to many places.

    :param maps: (K, H, W), each of positive mass; places: (N, 2), (u, v), also between pixels.
    """
    weights = maps.flatten(1)
    weights = weights / weights.sum(1, keepdim=True)
    grid = pixel_points(maps.shape[1:]).flatten(0, 1).to(places.device)  # (H W, 2)
    return weights @ torch.cdist(grid, places)


def distances_to_all_pixels(maps: np.ndarray) -> np.ndarray:
    """Return the expected distance (K, H, W), px, of each map (K, H, W) to every pixel."""
    H, W = maps.shape[1:]
    gaps = np.hypot(*np.mgrid[1 - H:H, 1 - W:W]).astype(np.float32)
    return np.stack([cv2.filter2D(m / m.sum(), -1, gaps, borderType=cv2.BORDER_CONSTANT)
                     for m in maps])
