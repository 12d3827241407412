# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the planner asks of a forward model, learned or true."""

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch


@runtime_checkable
class MapModel(Protocol):
    """
    Carries maps of objects on a square grid of the table, of n x n cells.

    planning.forward_model.ForwardModel is the learned one; the evaluation puts the simulator in
    its place.
    """

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the pictures it takes."""

    @property
    def device(self) -> torch.device:
        """Where it computes, and its tensors are."""

    def table_points(self) -> torch.Tensor:
        """Return the cells (n n, 2) in metres."""

    def pixel_table(self) -> torch.Tensor:
        """Return the pixel (n, n, 2) of every cell, (u, v)."""

    def seed_maps(self, pixels: torch.Tensor) -> torch.Tensor:
        """Put each object's map (K, n, n), which sums to 1, at its pixel (K, 2)."""

    def begin(self, image: torch.Tensor, gripper: torch.Tensor, arm_hidden: bool = False) -> Any:
        """
        Look once at what all sequences of a plan begin with.

        :param image: (1, 3, H, W) in [-1, 1]; gripper (1, 4) metres and opening.
        :param arm_hidden: the arm is not in the picture.
        :return: what carried_maps takes first.
        """

    def carried_maps(self, start: Any, gripper: torch.Tensor, maps: torch.Tensor,
                     actions: torch.Tensor, /, every: int = 1) -> Iterator[torch.Tensor]:
        """
        Yield the maps (N, K, n, n) after every so many steps of N action sequences.

        :param start: from begin; gripper (N, 4), where each sequence begins.
        :param maps: (K, n, n) now.
        :param actions: (N, T, 4), T a multiple of `every`.
        :return: each map sums to 1, or to 0 where nobody knows where the object is.
        """

    def gripper_after(self, gripper: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return where actions (T, 4) leave a gripper (4,), float32."""
