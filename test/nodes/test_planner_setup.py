# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a goal leaves open is filled in as the evaluation does."""

import pytest
from sim_bridge.tasks import TASKS
from tap_msgs.action import ReachGoal
from tap_ros.errors import ConfigError
from tap_ros.evaluation.planning.scenes import PLANNING_TASKS, step_budget
from tap_ros.nodes.planner_setup import check_request, default_budget


@pytest.mark.parametrize('task', PLANNING_TASKS)
def test_budgets_are_those_of_the_evaluation(task):
    assert default_budget(TASKS[task].num_objects) == step_budget(task)


def test_one_object_has_as_many_steps_as_two_and_four_as_three():
    assert (default_budget(1), default_budget(4)) == (40, 75)


def test_an_empty_mode_is_subgoal_and_the_limit_of_a_budget_is_named():
    assert check_request(ReachGoal.Goal(step_budget=1000)) == 'subgoal'
    with pytest.raises(ConfigError, match='1001; expected 1 to 1000, or 0 for 40, .* three.* 75'):
        check_request(ReachGoal.Goal(step_budget=1001))
