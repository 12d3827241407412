# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How likely a pose is right, from how well it fits."""

import numpy as np

# Logistic regression on simulated scenes, see docs/results/tracking.md.
_WEIGHTS = {'fit': 6.0, 'cost': -6.0, 'seen': 2.0}
_BIAS = 0.0


def probability(fit: float, cost: float, seen: float) -> float:
    """
    Return the probability that a pose is right within 2 px of a picture of 64.

    :param fit, cost, seen: see template.Pose.
    """
    value = (_BIAS + _WEIGHTS['fit'] * fit + _WEIGHTS['cost'] * cost + _WEIGHTS['seen'] * seen)
    return float(1 / (1 + np.exp(-value)))
