# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a machine can do at best, to hold times against."""

import time

import numpy as np
import torch

MATRIX = 2048  # side of the matrices whose product sets the rate,
MATRIX_GPU = 8192  # and on a GPU, which smaller ones do not fill


def matrix_rate(device, dtype, repeat=5):
    """
    Measure the rate of a large matrix product, the best of some.

    :param device: torch device or its name.
    :param dtype: of the matrices.
    :param repeat: how many products to time.
    :return: floating-point operations a second; a product and a sum are two.
    """
    torch.manual_seed(0)
    side = matrix_side(device)
    a, b = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    best = np.inf
    for _ in range(repeat + 1):
        begin = time.perf_counter()
        float((a @ b)[0, 0])  # waits for a GPU
        best = min(best, time.perf_counter() - begin)
    return 2 * side ** 3 / best


def matrix_side(device):
    """Return the side of the matrices that matrix_rate multiplies on a device."""
    return MATRIX if torch.device(device).type == 'cpu' else MATRIX_GPU
