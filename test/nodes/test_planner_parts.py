# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of visual_mpc_node without the node: checks of a goal, and plans as markers."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from tap_msgs.action import ReachGoal
from tap_ros.contract import ROBOT_MASKS
from tap_ros.errors import ConfigError
from tap_ros.nodes.planner.plan_view import encode_plan, way
from tap_ros.nodes.planner.settings import check_request, unlike_training
from tap_ros.nodes.topics import to_stamp
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
from visualization_msgs.msg import Marker


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


def test_pictures_unlike_those_of_the_training_are_named():
    for trained, robot_mask in product(ROBOT_MASKS, ROBOT_MASKS):
        model = LearnedForwardModel(
            ForwardModelConfig((1.0,) * 9, (1.0,) * 12, robot_mask=trained))
        told = unlike_training(model, robot_mask)
        assert bool(told) is (robot_mask != trained)
        assert not told or (f'robot_mask is {robot_mask}' in told and f'with {trained}' in told)


GRIPPER = np.array([0.1, -0.2, 0.05, 0.5], np.float32)


def points(marker):
    return np.array([(p.x, p.y, p.z) for p in marker.points])


def test_a_plan_is_drawn_with_what_it_was_chosen_from():
    rng = np.random.default_rng(0)
    elites = rng.uniform(-0.02, 0.02, (3, 15, 4))
    plan = SimpleNamespace(actions=elites[1], elites=elites, places=np.array([[0.2, 0.1], [0, 0]]))
    found = {m.ns: m for m in encode_plan(plan, GRIPPER, to_stamp(5 * 10**9), 'world').markers}
    assert set(found) == {'chosen', 'elites', 'targets', 'gripper'}
    assert len({m.id for m in found.values()}) == 4
    for marker in found.values():
        assert (marker.header.frame_id, marker.header.stamp.sec) == ('world', 5)
        assert marker.action == Marker.ADD and marker.color.a > 0 and marker.scale.x > 0
        assert marker.pose.orientation.w == 1
    np.testing.assert_allclose(points(found['chosen']), way(elites[1], GRIPPER))
    lines = points(found['elites']).reshape(3, 15, 2, 3)  # beginning and end of each move
    for line, actions in zip(lines, elites):
        np.testing.assert_allclose(line[:, 0], way(actions, GRIPPER)[:-1])
        np.testing.assert_allclose(line[:, 1], way(actions, GRIPPER)[1:])
    np.testing.assert_allclose(points(found['targets']), [[0.2, 0.1, 0], [0, 0, 0]])
    assert found['gripper'].pose.position.x == np.float32(0.1)


def test_without_elites_the_chosen_way_is_drawn():
    actions = np.zeros((15, 4))
    plan = SimpleNamespace(actions=actions, elites=actions[:0].reshape(0, 15, 4),
                           places=np.zeros((1, 2)))
    found = encode_plan(plan, GRIPPER, to_stamp(0), 'world').markers
    assert [len(m.points) for m in found] == [16, 0, 1, 0]
