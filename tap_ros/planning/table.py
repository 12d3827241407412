# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Between the picture and the table: homographies, projections and sampling of fields on the table.

Objects slide on a table, so their motion is rigid in metres on the table's plane and only there:
the forward model keeps its flow on a square grid of the table and looks into the picture through
a homography. Both are fitted from recordings, see fit_table and fit_arm.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import GRIPPER_JOINTS, ROBOT_MASK_HAND
from tap_ros.base.errors import RecordingError
import torch
from torch.nn import functional as F

if TYPE_CHECKING:
    from tap_ros.recording.episode import Episode


@dataclass(frozen=True)
class Table:
    """A square grid on the table, of n x n cells, and where it is in pictures."""

    homography: torch.Tensor  # (3, 3) table metres to pixels
    image_size: tuple[int, int]  # (height, width)
    cells: int = 44  # n
    half: float = 0.55  # m, half its side

    @property
    def device(self) -> torch.device:
        """Return where its tensors are."""
        return self.homography.device

    def points(self) -> torch.Tensor:
        """Return the cells (n n, 2) in metres."""
        return grid_points(self.cells).to(self.device).flatten(0, 1) * self.half

    def pixels(self) -> torch.Tensor:
        """Return the pixel (n, n, 2) of every cell, (u, v)."""
        return project(self.homography, self.points()).view(self.cells, self.cells, 2)

    def places(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return where on the table, in metres, pixels (..., N, 2) (u, v) are."""
        return project(torch.linalg.inv(self.homography), pixels)

    def apart(self, pixels: ArrayLike, others: ArrayLike) -> float:
        """Return the mean distance on the table, in metres, of pixels (N, 2) from others."""
        here, there = (self.places(torch.as_tensor(given, device=self.device))
                       for given in (pixels, others))
        return float((here - there).norm(dim=-1).mean())

    def seed_maps(self, pixels: torch.Tensor) -> torch.Tensor:
        """
        Put a map for each object on the grid, bilinearly at its pixel, then blur it by one cell.

        :param pixels: (K, 2) as (u, v). What is outside the table counts at its rim.
        :return: (K, n, n), each summing to 1.
        """
        n = self.cells
        points = self.places(pixels[:, None])
        at = ((points / self.half + 1) * (n - 1) / 2).clamp(0, n - 1.001)  # (K, 1, 2) x, y
        low = at.long()
        shares = torch.stack([1 - (at - low), at - low])
        maps = pixels.new_zeros(len(pixels), n * n)
        for dx, dy in product((0, 1), repeat=2):
            maps.scatter_add_(1, (low[..., 1] + dy) * n + low[..., 0] + dx,
                              shares[dx, ..., 0] * shares[dy, ..., 1])
        kernel = pixels.new_tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]) / 16
        maps = F.conv2d(maps.view(-1, 1, n, n), kernel[None, None], padding=1)[:, 0]
        return maps / maps.sum((-1, -2), keepdim=True).clamp_min(1e-12)


def project(matrix: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """
    Apply a homography (3, 3) or a camera (3, 4) to points (..., N, D) in metres.

    :param matrix: (..., 3, D + 1), broadcast against the points' leading axes but the last.
    :return: (..., N, 2) pixels (u, v).
    """
    rays = points @ matrix[..., :-1].transpose(-1, -2) + matrix[..., None, :, -1]
    return rays[..., :2] / rays[..., 2:]


def grid_points(cells: int) -> torch.Tensor:
    """
    Return the centres (cells, cells, 2) of a square grid, row y, column x, from -1 to 1.

    These are table units: metres divided by half the table's side.
    """
    line = torch.linspace(-1, 1, cells)
    return torch.stack(torch.meshgrid(line, line, indexing='xy'), dim=-1)


def pixel_points(size: Sequence[int]) -> torch.Tensor:
    """Return the pixel centres (H, W, 2) as (u, v)."""
    lines = torch.arange(size[1]), torch.arange(size[0])
    return torch.stack(torch.meshgrid(*lines, indexing='xy'), dim=-1).float()


def sample_picture(images: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Read pictures (B, C, H, W) at pixels (B, h, w, 2), (u, v), bilinearly: (B, C, h, w)."""
    height, width = images.shape[-2:]
    scale = pixels.new_tensor([2 / (width - 1), 2 / (height - 1)])
    return F.grid_sample(images, pixels * scale - 1, padding_mode='border', align_corners=True)


def sample(fields: torch.Tensor, points: torch.Tensor, padding: str = 'border') -> torch.Tensor:
    """Read fields (B, C, n, n) on the table grid at points (B, 2, h, w): (B, C, h, w)."""
    return F.grid_sample(fields, points.movedim(1, -1), padding_mode=padding, align_corners=True)


def shifted(points: torch.Tensor, flow: torch.Tensor, padding: str = 'border') -> torch.Tensor:
    """Return points (B, 2, h, w) moved by the flow (B, 2, n, n) that is there."""
    return points + sample(flow, points, padding)


def mirror_table(homography: torch.Tensor, width: int) -> torch.Tensor:
    """Return the homography of the mirrored picture over the table with x negated."""
    flip_u = homography.new_tensor([[-1.0, 0, width - 1], [0, 1, 0], [0, 0, 1]])
    flip_x = torch.diag(homography.new_tensor([-1.0, 1, 1]))
    return flip_u @ homography @ flip_x


def fit_projection(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """
    Fit a projection to matching points: linear start, then robust Gauss-Newton (Huber, 1 px).

    :param points: (N, D) metres, D = 2 for a homography, 3 for a camera.
    :param pixels: (N, 2) as (u, v).
    :return: (3, D + 1) float64 with its last entry 1.
    """
    count, dims = points.shape
    homogeneous = np.column_stack([points, np.ones(count)])
    matrix = np.zeros((3, dims + 1))
    matrix[:2] = np.linalg.lstsq(homogeneous, pixels, rcond=None)[0].T
    matrix[2, -1] = 1
    for _ in range(30):
        rays = homogeneous @ matrix.T
        error = pixels - rays[:, :2] / rays[:, 2:]  # (N, 2)
        weight = np.minimum(1, 1 / np.maximum(np.linalg.norm(error, axis=1), 1e-9))
        unit = homogeneous / rays[:, 2:]
        zero = np.zeros_like(unit)
        fall = -(rays[:, :2] / rays[:, 2:])[..., None] * unit[:, None, :-1]  # (N, 2, D)
        jacobian = np.concatenate([np.stack([
            np.hstack([unit, zero]), np.hstack([zero, unit])], 1), fall], 2)  # (N, 2, 3 D + 2)
        left = (jacobian * np.sqrt(weight)[:, None, None]).reshape(2 * count, -1)
        right = (error * np.sqrt(weight)[:, None]).reshape(-1)
        damping = 1e-6 * np.eye(left.shape[1])
        step = np.linalg.solve(left.T @ left + damping, left.T @ right)
        matrix.reshape(-1)[:-1] += step
    return matrix


def fit_arm(episodes: Iterable['Episode']) -> tuple[np.ndarray, float]:
    """
    Fit where the arm appears: a camera from gripper positions to the middle of the hand.

    Robot masks say where the hand is. Without them it is where the picture changes: from one
    frame to the next mostly the arm moves, and what it pushes lies around it. The weighted middle
    of the picture's change, regressed on the middle of the two gripper positions, needs no
    calibration and no labels. It lands on the arm's visible body, not its fingertips.

    :param episodes: iterable of recording Episodes.
    :return: (3, 4) float64, metres to pixels, and by how many pixels it misses the hand, as the
        median: up to 0.5 with robot masks, 1 to 2 without.
    :raises RecordingError: when grippers are missing or hardly move.
    """
    points, pixels = [], []
    for episode in episodes:
        hands = episode.grippers[:, :3]
        if episode.robot_masks is not None:
            mass = (episode.robot_masks == ROBOT_MASK_HAND).astype(np.float32)
        else:
            hands = (hands[1:] + hands[:-1]) / 2
            mass = np.abs(np.diff(episode.frames.astype(np.float32), axis=0)).sum(-1)
            mass[mass < 30] = 0
        middle, good = _middle(mass)
        good &= np.isfinite(hands).all(1)
        points.append(hands[good])
        pixels.append(middle[good])
    points, pixels = np.concatenate(points).astype(np.float64), np.concatenate(pixels)
    if len(points) < 50 or points[:, :2].std(0).min() < 0.01:
        raise RecordingError(
            '/joint_states: the forward model needs gripper positions of a moving arm '
            f'({", ".join(GRIPPER_JOINTS[:3])}); {len(points)} usable steps found')
    arm = fit_projection(points, pixels)
    seen = project(torch.from_numpy(arm), torch.from_numpy(points)).numpy()
    return arm, float(np.median(np.linalg.norm(seen - pixels, axis=1)))


def _middle(mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles (T, 2) of pictures of mass (T, H, W), and whether there is any (T,)."""
    total = mass.sum((1, 2))
    u = (mass.sum(1) @ np.arange(mass.shape[2])) / np.maximum(total, 1)
    v = (mass.sum(2) @ np.arange(mass.shape[1])) / np.maximum(total, 1)
    return np.column_stack([u, v]), total > 0


def fit_table(episodes: Iterable['Episode'], arm: np.ndarray) -> np.ndarray:
    """
    Fit the homography of the plane in which objects slide, table metres to pixels.

    Where the recordings hold object positions in metres and in pixels, these calibrate the camera
    (and are used for nothing else); otherwise the plane is that of the gripper at z = 0.

    :param episodes: iterable of recording Episodes.
    :param arm: (3, 4), see fit_arm.
    :return: (3, 3) float64.
    """
    points, pixels = (np.concatenate([values[..., :2].reshape(-1, 2) for values in all_values])
                      for all_values in zip(*((e.object_poses, e.object_pixels)
                                              for e in episodes)))
    known = np.isfinite(points).all(1) & np.isfinite(pixels).all(1)
    points, pixels = points[known], pixels[known]
    if len(points) < 50 or points.std(0).min() < 0.01:
        return arm[:, [0, 1, 3]]
    return fit_projection(points.astype(np.float64), pixels.astype(np.float64))
