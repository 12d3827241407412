# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the bootstrap intervals."""

import numpy as np
import pytest
from tap_ros.evaluation.intervals import (
    bootstrap,
    share_interval,
)


def test_shares_have_wilsons_interval_also_at_both_ends():
    z = 1.959964
    assert share_interval([1] * 10) == pytest.approx((1, 10 / (10 + z ** 2), 1), abs=1e-6)
    assert share_interval([0] * 10) == pytest.approx((0, 0, z ** 2 / (10 + z ** 2)), abs=1e-6)
    value, low, high = share_interval([1, 0] * 200)
    assert value == 0.5 and high - low == pytest.approx(2 * z * 0.025, rel=0.02)


def test_differences_are_paired():
    baseline = np.random.default_rng(2).uniform(1, 5, 50)

    def gain(errors):
        return bootstrap(lambda a, b: 1 - a.mean(-1) / b.mean(-1), errors, baseline)

    assert gain(0.75 * baseline) == pytest.approx((0.25, 0.25, 0.25))
    _, low, high = gain(0.75 * baseline[::-1])
    assert high - low > 0.1
