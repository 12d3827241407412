# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Windows of recordings for the forward model, and their augmentation."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.errors import RecordingError
from tap_ros.images.pixels import to_float
from tap_ros.planning.table import mirror_table
from tap_ros.training.robot_mask import hidden_pixels, RobotMask
import torch

if TYPE_CHECKING:
    from tap_ros.training.inpainted import Episodes

COLOUR_ORDERS = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))


@dataclass
class Windows:
    """A batch of B windows of T steps, that is T + 1 pictures."""

    images: torch.Tensor  # (B, T + 1, 3, H, W) in [-1, 1]
    hidden: torch.Tensor  # (B, T + 1, 1, H, W) bool, where the robot hides what is compared
    grippers: torch.Tensor  # (B, T + 1, 4) metres and opening
    actions: torch.Tensor  # (B, T, 4)
    homography: torch.Tensor  # (B, 3, 3) table metres to pixels; differs where mirrored
    mirrored: torch.Tensor  # (B,) bool
    colours: torch.Tensor  # (B, 3) int64: channel i shows what was channel colours[i]

    def to(self, device: torch.device | str) -> 'Windows':
        """Copy everything to a device."""
        return Windows(**{name: tensor.to(device) for name, tensor in vars(self).items()})


def read_windows(store: 'Episodes', episodes: np.ndarray | Sequence[int],
                 starts: np.ndarray | Sequence[int], steps: int, robot_mask: RobotMask = 'none',
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Read windows from a store.

    :param episodes: (B,) episode indices; starts (B,) first frames; steps T.
    :param robot_mask: see robot_mask.hidden_pixels; the episodes have masks unless it is 'none'.
    :return: images uint8 (B, T + 1, H, W, 3), grippers (B, T + 1, 4), actions (B, T, 4), and
        where the robot hides something, bool (B, T + 1, H, W).
    :raises RecordingError: where gripper positions are missing.
    """
    images, grippers, actions, hidden = [], [], [], []
    for i, start in zip(episodes, starts):
        episode = store[int(i)]
        images.append(episode.frames[start:start + steps + 1])
        grippers.append(episode.grippers[start:start + steps + 1])
        actions.append(episode.actions[start:start + steps])
        if robot_mask == 'none' or episode.robot_masks is None:
            hidden.append(np.zeros(images[-1].shape[:-1], bool))
        else:
            hidden.append(hidden_pixels(
                episode.robot_masks[start:start + steps + 1], robot_mask))
    grippers = np.stack(grippers).astype(np.float32)
    if not np.isfinite(grippers).all():
        bad = int(np.asarray(episodes)[~np.isfinite(grippers).all((1, 2))][0])
        raise RecordingError(
            f'/joint_states: episode {bad} lacks gripper positions; the forward model needs '
            f'{", ".join(GRIPPER_JOINTS)} at every picture')
    return np.stack(images), grippers, np.stack(actions).astype(np.float32), np.stack(hidden)


def draw_windows(store: 'Episodes', episodes: np.ndarray | Sequence[int], batch_size: int,
                 steps: int, homography: torch.Tensor, rng: np.random.Generator,
                 augment: bool = True, robot_mask: RobotMask = 'none') -> Windows:
    """
    Draw a batch of windows at random and augment it.

    :param episodes: episode indices to draw from, each with more than `steps` frames.
    :param homography: (3, 3) tensor, or (E, 3, 3), one for each episode of the store.
    :param rng: numpy Generator.
    :param robot_mask: see read_windows.
    :return: Windows.
    """
    chosen = rng.choice(episodes, batch_size)
    lengths = np.asarray(store.lengths)[chosen]
    starts = (rng.random(batch_size) * (lengths - steps)).astype(int)
    images, grippers, actions, hidden = read_windows(store, chosen, starts, steps, robot_mask)
    mirrored = rng.random(batch_size) < 0.5 * augment
    orders = rng.integers(len(COLOUR_ORDERS), size=batch_size) * augment
    homography = homography.expand(len(lengths), 3, 3) if homography.ndim == 2 else (
        homography[torch.from_numpy(chosen)])
    return augment_windows(images, grippers, actions, hidden, homography, mirrored, orders)


def augment_windows(images: np.ndarray, grippers: np.ndarray, actions: np.ndarray,
                    hidden: np.ndarray, homography: torch.Tensor, mirrored: np.ndarray,
                    orders: np.ndarray) -> Windows:
    """
    Mirror pictures left to right and swap their colour channels, everything else to match.

    :param images: uint8 (B, T + 1, H, W, 3); grippers (B, T + 1, 4); actions (B, T, 4).
    :param hidden: bool (B, T + 1, H, W).
    :param homography: (3, 3) or (B, 3, 3) tensor; mirrored (B,) bool; orders (B,) index to
        COLOUR_ORDERS.
    :return: Windows; the grippers and actions of mirrored ones have x negated.
    """
    batch = Windows(
        to_float(images), torch.from_numpy(hidden[:, :, None]),
        torch.from_numpy(grippers.copy()), torch.from_numpy(actions.copy()),
        homography.expand(len(images), 3, 3).clone(), torch.from_numpy(np.asarray(mirrored)),
        torch.tensor([COLOUR_ORDERS[i] for i in orders]))
    batch.images = recolour(batch.images, batch.colours[:, None])
    batch.images = mirror(batch.images, batch.mirrored)
    batch.hidden = mirror(batch.hidden, batch.mirrored)
    batch.grippers[batch.mirrored, :, 0] *= -1
    batch.actions[batch.mirrored, :, 0] *= -1
    batch.homography[batch.mirrored] = mirror_table(
        batch.homography, images.shape[3])[batch.mirrored]
    return batch


def recolour(images: torch.Tensor, colours: torch.Tensor) -> torch.Tensor:
    """Reorder the first three channels of images (B, ..., C, H, W) by colours (B, ..., 3)."""
    index = colours[..., None, None].expand(*images.shape[:-3], 3, *images.shape[-2:])
    return torch.cat([images[..., :3, :, :].gather(-3, index), images[..., 3:, :, :]], -3)


def mirror(images: torch.Tensor, mirrored: torch.Tensor) -> torch.Tensor:
    """Flip those images (B, ..., H, W) left to right that are mirrored (B,)."""
    shape = [-1] + [1] * (images.ndim - 1)
    return torch.where(mirrored.view(shape), images.flip(-1), images)
