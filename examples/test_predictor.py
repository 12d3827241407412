# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import load_predictor


def test_it_predicts_what_is_half_way():
    start, goal = np.zeros((64, 64, 3), np.uint8), np.full((64, 64, 3), 80, np.uint8)
    subgoal, = load_predictor('half_way:').predict(
        start, goal, np.array([[10, 20]]), np.array([[30, 40]]))
    assert (subgoal.image == 40).all() and subgoal.expected_pixels.tolist() == [[20, 30]]
