# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of action sequences and of the proposals for them."""

import numpy as np
import pytest
from tap_ros.contract import LIFTED, LOW
from tap_ros.planning.action_sequences import (
    join,
    landings,
    Limits,
    MOVES,
    push_proposals,
    SequenceShape,
    shift,
    SIZE,
)

SHAPE = SequenceShape()
LOW_GRIPPER = np.array([0.1, 0.2, 0.01, 0.0], np.float32)


def random_parameters(count=20, seed=0):
    rng = np.random.default_rng(seed)
    parameters = rng.normal(0, 0.06, (count, SIZE))
    parameters[:, 2 * MOVES:] = rng.integers(0, 5, (count, 1))
    return SHAPE.clip(parameters)


def heights(actions, start):
    return start + actions[..., 2].astype(float).cumsum(1)


def test_actions_stay_within_the_limits():
    parameters = SHAPE.clip(np.random.default_rng(0).normal(0, 1, (50, SIZE)))
    actions = SHAPE.actions(parameters, 0.07)
    assert actions.shape == (50, 15, 4) and actions.dtype == np.float32
    assert np.abs(actions[..., :2]).max() <= 0.08 + 1e-6
    assert np.abs(actions[..., 2]).max() <= 0.15 + 1e-6
    assert (actions[..., 3] == 0).all()


def test_gripper_is_lifted_for_the_segments_asked_for():
    for lifted in range(5):
        parameters = join(np.zeros((0, 2)), lifted, 0)[None]
        height = heights(SHAPE.actions(parameters, 0.05), 0.05)[0]
        np.testing.assert_allclose(height[:3 * lifted], LIFTED, atol=1e-6)
        np.testing.assert_allclose(height[3 * lifted:], LOW, atol=1e-6)


def test_the_first_segment_is_as_short_as_the_phase_says():
    for phase in range(3):
        parameters = join(np.tile([[0.01, 0.0], [0.02, 0.0]], (3, 1)), 1, phase)
        actions, = SHAPE.actions(SHAPE.clip(parameters[None]), LIFTED)
        first = 3 - phase
        np.testing.assert_allclose(actions[:first, 0], 0.01, atol=1e-7)
        assert actions[first, 2] < -0.1 and not actions[first, 0]  # it comes down on the spot
        np.testing.assert_allclose(actions[first + 1:first + 3, 0], 0.02, atol=1e-7)
        assert SHAPE.clip(parameters[None] + 9)[0, -1] == 2


def test_the_arm_does_not_move_sideways_while_it_climbs_and_pushes_slowly():
    actions = SHAPE.actions(random_parameters(), 0.01)
    climbing = np.abs(actions[..., 2]) > 0.06
    assert climbing.any() and not actions[climbing][:, :2].any()
    low = random_parameters()
    low[:, -2] = 0
    for limits, most in ((Limits(), 0.05), (Limits(0.03), 0.03)):
        length = np.linalg.norm(SequenceShape(limits).actions(low, LOW)[..., :2], axis=-1)
        assert length.max() == pytest.approx(most, abs=1e-6)


def test_a_shifted_plan_goes_on_as_planned():
    parameters, height = random_parameters(1), 0.1
    for _ in range(7):
        before = SHAPE.actions(parameters, height)[0]
        parameters = shift(parameters[0])[None]
        height = float(height + before[0, 2])
        after = SHAPE.actions(parameters, height)[0]
        np.testing.assert_allclose(after[:14], before[1:], atol=1e-6)


def test_landings_are_where_the_gripper_comes_down():
    parameters = np.zeros((2, SIZE))
    parameters[:, 0] = 0.05
    parameters[0, -2] = 1
    gripper = np.array([0.0, 0.1, LOW, 0])
    found = landings(SHAPE.actions(parameters, LOW), gripper)
    np.testing.assert_allclose(found[0], [0.1, 0.1], atol=1e-6)  # two periods at 0.05 m
    assert np.isnan(found[1]).all()


def test_proposals_end_beyond_the_object_on_its_way_to_the_goal():
    objects, goals = np.array([[0.0, 0.0], [0.2, 0.2]]), np.array([[0.2, 0.0], [0.2, 0.2]])
    rng = np.random.default_rng(0)
    proposals = push_proposals(SHAPE, LOW_GRIPPER, objects, goals, 40, rng)
    actions = SHAPE.actions(SHAPE.clip(proposals), LOW_GRIPPER[2])
    path = LOW_GRIPPER[:2] + actions[..., :2].cumsum(1)
    assert (landings(actions, LOW_GRIPPER)[:, 0] < -0.05).all()  # behind the one not at its goal
    assert np.median(path[:, -1, 0]) > 0.05 and np.abs(path[:, -1, 1]).mean() < 0.1
    lifted = (heights(actions, LOW_GRIPPER[2]) > 0.1).sum(1)
    assert (lifted % 3 > 0).any()  # no longer than needed


class Means:
    """A Generator that draws the mean of every distribution."""

    def choice(self, options, count, p):
        return np.full(count, np.argmax(p))

    def normal(self, mean, _):
        return mean

    def uniform(self, low, high):
        return (low + high) / 2


@pytest.mark.parametrize('distance', [0.03, 0.06, 0.15])  # the first takes a single period
def test_a_push_ends_with_the_object_in_its_place_however_few_periods_it_takes(distance):
    gripper, goal = np.array([-0.06, 0.0, LOW, 0.0]), np.array([[distance, 0.0]])
    proposal = push_proposals(SHAPE, gripper, np.zeros((1, 2)), goal, 1, Means())
    actions, = SHAPE.actions(SHAPE.clip(proposal), LOW)
    end = gripper[:2] + actions[:, :2].sum(0)
    np.testing.assert_allclose(end, [distance + 0.07 - 0.135, 0], atol=1e-6)


@pytest.mark.parametrize('limit', [0.02, 0.04, 0.09, 0.15])
def test_replanning_with_small_limits_the_gripper_comes_down(limit):
    shape, height = SequenceShape(Limits(climb=limit)), LIFTED
    for _ in range(12):
        parameters = np.zeros((1, SIZE))
        parameters = shape.clip(parameters, least_lift=shape.least_lift(height))
        height += shape.actions(parameters, height)[0, 0, 2]
    assert height == pytest.approx(LOW, abs=1e-6)
