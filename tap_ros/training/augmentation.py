# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changes of how pictures look: mirrored, in other colours, brighter or darker."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch


def recolour(images: torch.Tensor, order: torch.Tensor) -> torch.Tensor:
    """Take the channels of images (B, ..., 3, H, W) in the order (B, ..., 3)."""
    return images.gather(-3, order[..., None, None].expand_as(images))


def mirror(images: torch.Tensor, mirrored: torch.Tensor) -> torch.Tensor:
    """Flip those images (B, ..., H, W) left to right that are mirrored (B,)."""
    shape = [-1] + [1] * (images.ndim - 1)
    return torch.where(mirrored.view(shape), images.flip(-1), images)


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
    def draw(cls, batch_size: int, colour: bool, brightness: float,
             rng: np.random.Generator) -> Self:
        """
        Draw one for each episode of a batch; half of them are mirrored.

        :param colour: whether to permute their colour channels.
        :param brightness: gains lie within 1 +- this.
        """
        order = np.argsort(rng.random((batch_size, 3)), 1)
        if not colour:
            order = np.tile(np.arange(3), (batch_size, 1))
        flips = rng.random(batch_size) < 0.5
        gain = 1 + brightness * rng.uniform(-1, 1, (batch_size, 3))
        return cls(*map(torch.from_numpy, (flips, order, gain.astype(np.float32))))

    def to(self, device: torch.device | str, non_blocking: bool = False) -> 'Augmentation':
        """Copy everything to a device."""
        return Augmentation(**{name: value.to(device, non_blocking=non_blocking)
                               for name, value in vars(self).items()})

    def apply(self, images: torch.Tensor) -> torch.Tensor:
        """Change pictures (B, N, 3, H, W) in [-1, 1]; a gain may brighten them beyond 1."""
        images = recolour(images, self.order[:, None])
        return mirror((images + 1) * self.gain[:, None, :, None, None] - 1, self.flip)

    def undo(self, images: torch.Tensor) -> torch.Tensor:
        """Change pictures (B, N, 3, H, W), as apply returned them, back."""
        images = (mirror(images, self.flip) + 1) / self.gain[:, None, :, None, None] - 1
        return recolour(images, self.order.argsort(1)[:, None])
