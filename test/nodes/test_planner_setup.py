# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a goal leaves open is filled in, and what is out of range refused."""

import pytest
from tap_msgs.action import ReachGoal
from tap_ros.contract import ROBOT_MASKS
from tap_ros.errors import ConfigError
from tap_ros.nodes.planner.settings import check_request, unlike_training
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel


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


@pytest.mark.parametrize('trained', ROBOT_MASKS)
def test_pictures_unlike_those_of_the_training_are_named(trained):
    model = LearnedForwardModel(ForwardModelConfig((1.0,) * 9, (1.0,) * 12, robot_mask=trained))
    for robot_mask in ROBOT_MASKS:
        told = unlike_training(model, robot_mask)
        assert bool(told) is (robot_mask != trained)
        assert not told or (f'robot_mask is {robot_mask}' in told and f'with {trained}' in told)
