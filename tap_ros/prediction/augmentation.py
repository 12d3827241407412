# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changes of appearance that make few episodes into many."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch


@dataclass(frozen=True)
class Augmentation:
    """
    A change of appearance, the same for all pictures of an episode, that can be undone.

    :param flip: bool (B,), mirror left and right.
    :param order: int64 (B, 3), which channel each colour channel is taken from.
    :param gain: (B, 3), factor on each channel's brightness.
    """

    flip: torch.Tensor
    order: torch.Tensor
    gain: torch.Tensor

    @classmethod
    def draw(cls, batch_size: int, flip: bool, colour: bool, brightness: float,
             rng: np.random.Generator) -> Self:
        """
        Draw one for each episode of a batch.

        :param batch_size: B.
        :param flip: whether to mirror half of them.
        :param colour: whether to permute their colour channels.
        :param brightness: gains lie within 1 +- this.
        :param rng: numpy Generator.
        :return: Augmentation.
        """
        order = np.argsort(rng.random((batch_size, 3)), 1)
        if not colour:
            order = np.tile(np.arange(3), (batch_size, 1))
        flips = rng.random(batch_size) < (0.5 if flip else 0.0)
        gain = 1 + brightness * rng.uniform(-1, 1, (batch_size, 3))
        return cls(torch.from_numpy(flips), torch.from_numpy(order),
                   torch.from_numpy(gain.astype(np.float32)))

    def part(self, part: slice) -> 'Augmentation':
        """Return that of a slice of the episodes."""
        return Augmentation(self.flip[part], self.order[part], self.gain[part])

    def to(self, device: torch.device | str) -> 'Augmentation':
        """Copy everything to a device."""
        return Augmentation(self.flip.to(device), self.order.to(device), self.gain.to(device))

    def apply(self, images: torch.Tensor) -> torch.Tensor:
        """
        Change pictures.

        :param images: (B, N, 3, H, W) in [-1, 1].
        :return: the same shape; beyond 1 where a gain brightens what was bright.
        """
        images = _take_channels(images, self.order)
        images = (images + 1) * self.gain[:, None, :, None, None] - 1
        return torch.where(self.flip[:, None, None, None, None], images.flip(-1), images)

    def undo(self, images: torch.Tensor) -> torch.Tensor:
        """
        Change pictures back.

        :param images: (B, N, 3, H, W), as apply returned them.
        :return: the same shape.
        """
        images = torch.where(self.flip[:, None, None, None, None], images.flip(-1), images)
        images = (images + 1) / self.gain[:, None, :, None, None] - 1
        return _take_channels(images, self.order.argsort(1))


def _take_channels(images: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    order = order[:, None, :, None, None].expand_as(images)
    return images.gather(2, order)
