# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from tap_ros import get_arm


def test_it_reaches_a_place():
    arm, place = get_arm('tall'), [0.1, 0.0, 0.05]  # m
    assert abs(arm.gripper_at(arm.joints_at(place)) - place).max() < 1e-6
