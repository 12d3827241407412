# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a goal leaves open is filled in, and what is out of range refused."""

import pytest
from tap_msgs.action import ReachGoal
from tap_ros.errors import ConfigError
from tap_ros.nodes.planner_setup import check_request


def test_an_empty_mode_is_subgoal_and_the_limit_of_a_budget_is_named():
    assert check_request(ReachGoal.Goal(step_budget=1000)) == 'subgoal'
    with pytest.raises(ConfigError, match='1001; expected 1 to 1000, or 0 for 40, .* three.* 75'):
        check_request(ReachGoal.Goal(step_budget=1001))


def test_samples_that_are_weighed_are_bounded_and_those_of_direct_goals_are_not_looked_at():
    check_request(ReachGoal.Goal(num_samples=32))
    check_request(ReachGoal.Goal(num_samples=1, recursion_depth=100))
    check_request(ReachGoal.Goal(mode='direct', num_samples=100))
    with pytest.raises(ConfigError, match='33 x 2 = 66; at most 64 plans'):
        check_request(ReachGoal.Goal(num_samples=33))
