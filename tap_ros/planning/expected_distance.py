# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How far an object under a map is from a place x: E_q|x - y|, the mean over y of the map q.

The same for one place of each map, for any number of places, and for all pixels. The first is
exact; the others are fast, and off by rounding: at most 0.05 px.
"""

import cv2
import numpy as np
from tap_ros.planning.table import pixel_points
import torch


def distances_to_pixels(maps: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """
    Compute the expected distance of each map to a place of its own.

    :param maps: (..., H, W), each sums to 1.
    :param pixels: (..., 2), (u, v).
    :return: (...), in pixels.
    """
    H, W = maps.shape[-2:]
    u = torch.arange(W, device=maps.device) - pixels[..., 0, None, None]
    v = torch.arange(H, device=maps.device)[:, None] - pixels[..., 1, None, None]
    return (maps * torch.sqrt(u ** 2 + v ** 2)).sum((-2, -1))


def distances_to_places(maps: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """
    Compute the expected distance of each map to many places.

    :param maps: (K, H, W), each of positive mass.
    :param places: (N, 2), (u, v), also between pixels.
    :return: (K, N), in pixels.
    """
    weights = maps.flatten(1)
    weights = weights / weights.sum(1, keepdim=True)
    grid = pixel_points(maps.shape[1:]).flatten(0, 1).to(places.device)  # (H W, 2)
    return weights @ torch.cdist(grid, places)


def distances_to_all_pixels(maps: np.ndarray) -> np.ndarray:
    """
    Compute the expected distance of each map to every pixel of the picture.

    :param maps: numpy float32 (K, H, W), each of positive mass.
    :return: numpy float32 (K, H, W), in pixels.
    """
    H, W = maps.shape[1:]
    gaps = np.hypot(*np.mgrid[1 - H:H, 1 - W:W]).astype(np.float32)
    return np.stack([cv2.filter2D(m / m.sum(), -1, gaps, borderType=cv2.BORDER_CONSTANT)
                     for m in maps])
