# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

import numpy as np
from tap_ros import Scene, VisualMPC


def test_a_plan_brings_the_object_nearer():
    planner, pixels = VisualMPC.load('telekinesis:push'), np.array([[20.0, 40.0]])
    scene = Scene(np.zeros((64, 64, 3), np.uint8), np.zeros(4), pixels)
    plan = planner.plan(scene, planner.goal(pixels + 10))
    assert plan.expected_distance < 10  # px; now it is 14
