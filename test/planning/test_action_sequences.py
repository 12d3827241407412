# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of action sequences and of the proposals for them."""

import numpy as np
import pytest
from tap_ros.contract import LIFTED, LOW
from tap_ros.planning.action_sequences import SequenceShape
from tap_ros.planning.proposals import push_proposals

SHAPE = SequenceShape()
FREE = SequenceShape(phase=None)
LOW_GRIPPER = np.array([0.1, 0.2, 0.01, 0.0], np.float32)


def random_parameters(shape, count=20, seed=0):
    rng = np.random.default_rng(seed)
    parameters = rng.normal(0, 0.06, (count, shape.size))
    parameters[:, 2 * shape.num_moves:] = rng.integers(0, 5, (count, 1))
    return shape.clip(parameters)


def heights(actions, start):
    return start + actions[..., 2].astype(float).cumsum(1)


def test_actions_stay_within_the_limits():
    for upright in (True, False):
        shape = SequenceShape(upright=upright)
        parameters = shape.clip(np.random.default_rng(0).normal(0, 1, (50, shape.size)))
        actions = shape.actions(parameters, 0.07)
        assert actions.shape == (50, 15, 4) and actions.dtype == np.float32
        assert np.abs(actions[..., :2]).max() <= 0.08 + 1e-6
        assert np.abs(actions[..., 2]).max() <= 0.15 + 1e-6
        assert (actions[..., 3] == 0).all()


@pytest.mark.parametrize('lifted', range(5))
def test_gripper_is_lifted_for_the_segments_asked_for(lifted):
    parameters = np.zeros((1, SHAPE.size))
    parameters[0, -1] = lifted
    height = heights(SHAPE.actions(parameters, 0.05), 0.05)[0]
    np.testing.assert_allclose(height[:3 * lifted], LIFTED, atol=1e-6)
    np.testing.assert_allclose(height[3 * lifted:], LOW, atol=1e-6)


@pytest.mark.parametrize('phase', range(3))
def test_the_first_segment_is_as_short_as_the_free_phase_says(phase):
    moves = np.tile([[0.01, 0.0], [0.02, 0.0]], (3, 1))
    parameters = FREE.join(moves, 1, phase)
    actions, = FREE.actions(FREE.clip(parameters[None]), LIFTED)
    first = 3 - phase
    np.testing.assert_allclose(actions[:first, 0], 0.01, atol=1e-7)
    assert actions[first, 2] < -0.1 and not actions[first, 0]  # it comes down on the spot
    np.testing.assert_allclose(actions[first + 1:first + 3, 0], 0.02, atol=1e-7)
    assert FREE.clip(parameters[None] + 9)[0, -1] == 2


def test_upright_arm_does_not_move_sideways_while_it_climbs():
    actions = SHAPE.actions(random_parameters(SHAPE), 0.01)
    climbing = np.abs(actions[..., 2]) > 0.06
    assert climbing.any() and not actions[climbing][:, :2].any()


def test_low_pushes_are_slow():
    shape = SequenceShape(push_limit=0.03)
    parameters = random_parameters(shape)
    parameters[:, -1] = 0
    length = np.linalg.norm(shape.actions(parameters, LOW)[..., :2], axis=-1)
    assert length.max() <= 0.03 + 1e-6


@pytest.mark.parametrize('shape', [SHAPE, FREE])
def test_a_shifted_plan_goes_on_as_planned(shape):
    parameters, height = random_parameters(shape, 1), 0.1
    for _ in range(7):
        before = shape.actions(parameters, height)[0]
        parameters = shape.shift(parameters[0])[None]
        shape, height = shape.following(), float(height + before[0, 2])
        after = shape.actions(parameters, height)[0]
        np.testing.assert_allclose(after[:14], before[1:], atol=1e-6)


def test_landings_are_where_the_gripper_comes_down():
    parameters = np.zeros((2, SHAPE.size))
    parameters[:, 0] = 0.05
    parameters[0, -1] = 1
    gripper = np.array([0.0, 0.1, LOW, 0])
    landings = SHAPE.landings(SHAPE.actions(parameters, LOW), gripper)
    np.testing.assert_allclose(landings[0], [0.1, 0.1], atol=1e-6)  # two periods at 0.05 m
    assert np.isnan(landings[1]).all()


def test_proposals_end_beyond_the_object_on_its_way_to_the_goal():
    objects, goals = np.array([[0.0, 0.0], [0.2, 0.2]]), np.array([[0.2, 0.0], [0.2, 0.2]])
    rng = np.random.default_rng(0)
    proposals = push_proposals(SHAPE, LOW_GRIPPER, objects, goals, 40, rng)
    actions = SHAPE.actions(SHAPE.clip(proposals), LOW_GRIPPER[2])
    path = LOW_GRIPPER[:2] + actions[..., :2].cumsum(1)
    landings = SHAPE.landings(actions, LOW_GRIPPER)
    assert (landings[:, 0] < -0.05).all()  # behind the only object that is not at its goal
    assert np.median(path[:, -1, 0]) > 0.05 and np.abs(path[:, -1, 1]).mean() < 0.1


def test_a_free_phase_lets_the_gripper_travel_no_longer_than_needed():
    rng, goal = np.random.default_rng(0), np.array([[0.15, 0.0]])
    periods = {}
    for shape in (SHAPE, FREE):
        proposals = push_proposals(shape, LOW_GRIPPER, np.zeros((1, 2)), goal, 40, rng)
        actions = shape.actions(shape.clip(proposals), LOW_GRIPPER[2])
        assert np.isfinite(shape.landings(actions, LOW_GRIPPER)).all()
        periods[shape] = (heights(actions, LOW_GRIPPER[2]) > 0.1).sum(1)
    assert (periods[SHAPE] % 3 == 0).all() and (periods[FREE] % 3 > 0).any()
    assert periods[FREE].mean() < periods[SHAPE].mean() - 0.5


def test_a_gripper_already_behind_the_object_is_not_lifted():
    gripper = np.array([-0.12, 0.0, 0.01, 0.0])
    proposals = push_proposals(
        SHAPE, gripper, np.zeros((1, 2)), np.array([[0.15, 0.0]]), 20, np.random.default_rng(0))
    assert (proposals[:, -1] == 0).mean() > 0.7


class Means:
    """A Generator that draws the mean of every distribution."""

    def choice(self, options, count, p):
        return np.full(count, np.argmax(p))

    def normal(self, mean, _):
        return mean

    def uniform(self, low, high):
        return (low + high) / 2


@pytest.mark.parametrize('shape', [SHAPE, FREE])
@pytest.mark.parametrize('distance', [0.03, 0.06, 0.15])  # the first takes a single period
def test_a_push_ends_with_the_object_in_its_place_however_few_periods_it_takes(shape, distance):
    gripper, goal = np.array([-0.06, 0.0, LOW, 0.0]), np.array([[distance, 0.0]])
    proposal = push_proposals(shape, gripper, np.zeros((1, 2)), goal, 1, Means())
    actions, = shape.actions(shape.clip(proposal), LOW)
    end = gripper[:2] + actions[:, :2].sum(0)
    np.testing.assert_allclose(end, [distance + 0.07 - 0.135, 0], atol=1e-6)


def test_nothing_is_proposed_when_all_is_in_place():
    places = np.array([[0.1, 0.1]])
    rng = np.random.default_rng(0)
    assert len(push_proposals(SHAPE, LOW_GRIPPER, places, places, 10, rng)) == 0


def test_with_a_small_limit_the_gripper_climbs_in_several_periods_and_waits_meanwhile():
    shape = SequenceShape(climb_limit=0.03)
    parameters = np.full((1, shape.size), 0.05)
    parameters[0, -1] = 4
    actions = shape.actions(parameters, LOW)[0]
    assert np.abs(actions[:, 2]).max() <= 0.03 + 1e-7
    heights = LOW + actions[:, 2].cumsum()
    assert heights.max() == pytest.approx(LIFTED, abs=1e-6)
    still = ~actions[:, :2].any(1)
    assert still[0] and heights[still][0] < heights[~still].max()
    landing, = shape.landings(actions[None], np.array([0, 0, LOW, 0]))
    assert np.isfinite(landing).all()  # it comes down again, in steps


@pytest.mark.parametrize('limit', [0.02, 0.04, 0.09, 0.15])
def test_replanning_with_small_limits_the_gripper_comes_down(limit):
    shape, height = SequenceShape(climb_limit=limit), LIFTED
    for _ in range(12):
        parameters = np.zeros((1, shape.size))
        parameters = shape.clip(parameters, least_lift=shape.least_lift(height))
        height += shape.actions(parameters, height)[0, 0, 2]
    assert height == pytest.approx(LOW, abs=1e-6)
