# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How likely a pose is right, from how well it fits."""

import numpy as np
from tap_ros.tracking.protocols import HIDDEN, LOST, UNSURE

# Logistic regression on 11,000 poses in simulated scenes other than those of
# docs/results/tracking.md.
_WEIGHTS = {'fit': 3.25, 'cost': -7.59, 'seen': 2.55}
_BIAS = 1.74
# Of the last place of an object: at once, and the factor of each further picture.
_DOUBT = {HIDDEN: (0.88, 0.95), UNSURE: (0.5, 0.9), LOST: (0.5, 0.9)}


def probability(fit: float, cost: float, seen: float) -> float:
    """
    Return the probability that a pose is right within 2 px of a picture of 64.

    :param fit, cost, seen: see template.Pose.
    """
    value = (_BIAS + _WEIGHTS['fit'] * fit + _WEIGHTS['cost'] * cost + _WEIGHTS['seen'] * seen)
    return float(1 / (1 + np.exp(-value)))


def doubt(state: str, age: int) -> float:
    """Return the same of the last pixel of an object that was not seen in so many pictures."""
    first, fall = _DOUBT[state]
    return first * fall ** (age - 1)
