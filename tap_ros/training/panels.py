# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What networks say, as panels of a picture for people."""

from typing import TYPE_CHECKING

import numpy as np
from tap_ros.images.pixels import to_uint8

if TYPE_CHECKING:
    import torch


def grey_panels(maps: 'torch.Tensor') -> list[np.ndarray]:
    """
    Show numbers from 0 to 1 as grey.

    :param maps: tensor (N, H, W).
    :return: list of N uint8 (H, W, 3).
    """
    return list(to_uint8(maps[:, None].expand(-1, 3, -1, -1) * 2 - 1))
