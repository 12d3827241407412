# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from tap_ros import Simulator


def test_its_expert_succeeds():
    simulator = Simulator('visit')
    assert simulator.demonstrate(seed=0).episode.outcome == 'success'
