# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from tap_ros import VisualMPC
import torch


class Telekinesis:
    """All objects go where the gripper goes, whether it touches them or not."""

    def __init__(self, table):
        self.table = table

    @classmethod
    def load(cls, argument, device='cpu'):
        return cls(VisualMPC.load(argument, device=device).model.table)

    def begin(self, image, gripper, arm_hidden=False):
        return None  # what carried_maps gets first

    def carried_maps(self, start, gripper, maps, actions, /, every=1):
        scale = (self.table.cells - 1) / (2 * self.table.half)  # cells a metre
        for t in range(every, actions.shape[1] + 1, every):
            ways = (scale * actions[:, :t, :2].sum(1)).round().int().tolist()
            yield torch.stack([maps.roll((y, x), (-2, -1)) for x, y in ways])
