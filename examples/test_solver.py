# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import load_plugin, Problem, SearchConfig


def test_it_finds_less_than_it_begins_with():
    def clip(samples):
        assert samples.ndim == 2  # (N, D), as the planner's
        return samples.clip(-2, 2)

    problem = Problem(lambda samples: (samples ** 2).sum(1), np.ones(3), np.ones(3), clip)
    solver = load_plugin('tap_ros.solvers', 'random')
    assert solver(problem, SearchConfig(), np.random.default_rng(0)).cost < 1
