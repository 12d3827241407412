# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What changes over a training: learning rate, temperature of the match, price of z."""

import math


def learning_rate(step: int, steps: int, warmup: int, highest: float) -> float:
    """
    Compute a step's learning rate: a linear rise, then half a cosine down to 2 %.

    :param step: from 0 on.
    :param steps: length of the training.
    :param warmup: steps of the rise.
    :param highest: the rate after the rise.
    :return: the rate.
    """
    rise = min(1.0, (step + 1) / (warmup + 1))
    fall = 0.5 + 0.5 * math.cos(math.pi * step / steps)
    return highest * rise * (0.02 + 0.98 * fall)


def match_temperature(step: int, steps: int, highest: float, share: float) -> float:
    """
    Compute a step's temperature of the match: a linear fall to 0, where it stays.

    :param step: from 0 on.
    :param steps: length of the training.
    :param highest: the temperature of step 0.
    :param share: of the training, after which it is 0.
    :return: the temperature.
    """
    return highest * max(0.0, 1 - step / (share * steps))


def kl_share(step: int, steps: int, warmup: float) -> float:
    """
    Compute which share of its weight the KL divergence has at a step: 0, a linear rise, then 1.

    Adam scales gradients, so that even a small price can shut z off before it is of use.

    :param step: from 0 on.
    :param steps: length of the training.
    :param warmup: share of the training in which it is 0, and over which it then rises; 0: the
        share is 1 from the start.
    :return: the share, 0 to 1.
    """
    return min(1.0, max(0.0, step / (warmup * steps) - 1)) if warmup else 1.0
