# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from tap_ros import load_plugin


def test_its_goal_is_reached():
    world = load_plugin('tap_ros.worlds', 'dot')('dot')
    world.reset(seed=3)
    assert world.outcome() == 'failure'
    for _ in range(2):
        world.step([0.05, 0, 0, 0])
    assert world.outcome() == 'success'
