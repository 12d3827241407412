# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of action sequences and of the proposals for them."""

import numpy as np
import pytest
from tap_ros.base.contract import LIFTED, LOW
from tap_ros.planning.action_sequences import (
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


def test_the_arm_does_not_move_sideways_while_it_climbs_and_pushes_slowly():
    actions = SHAPE.actions(random_parameters(), LOW_GRIPPER)
    climbing = np.abs(actions[..., 2]) > 0.06
    assert climbing.any() and not actions[climbing][:, :2].any()
    low = random_parameters()
    low[:, -2] = 0
    for limits, most in ((Limits(), 0.05), (Limits(0.03), 0.03)):
        length = np.linalg.norm(SequenceShape(limits).actions(low, LOW_GRIPPER)[..., :2], axis=-1)
        assert length.max() == pytest.approx(most, abs=1e-6)


def test_a_shifted_plan_goes_on_as_planned():
    parameters, gripper = random_parameters(1), np.array([0.1, 0.2, 0.1, 0])
    for _ in range(7):
        before = SHAPE.actions(parameters, gripper)[0]
        parameters = shift(parameters[0])[None]
        gripper = gripper + before[0]
        after = SHAPE.actions(parameters, gripper)[0]
        np.testing.assert_allclose(after[:14], before[1:], atol=1e-6)


def test_proposals_end_beyond_the_object_on_its_way_to_the_goal():
    objects, goals = np.array([[0.0, 0.0], [0.2, 0.2]]), np.array([[0.2, 0.0], [0.2, 0.2]])
    rng = np.random.default_rng(0)
    proposals = push_proposals(SHAPE, LOW_GRIPPER, objects, goals, 40, rng)
    actions = SHAPE.actions(SHAPE.clip(proposals), LOW_GRIPPER)
    path = LOW_GRIPPER[:2] + actions[..., :2].cumsum(1)
    assert (landings(actions, LOW_GRIPPER)[:, 0] < -0.05).all()  # behind the one not at its goal
    assert np.median(path[:, -1, 0]) > 0.05 and np.abs(path[:, -1, 1]).mean() < 0.1
    lifted = (heights(actions, LOW_GRIPPER[2]) > 0.1).sum(1)
    assert (lifted % 3 > 0).any()  # no longer than needed


def test_what_is_out_of_reach_is_pushed_from_another_side():
    objects, goals = np.array([[0.0, 0.4]]), np.array([[0.0, 0.2]])
    high = np.array([0.0, 0.0, LIFTED, 0], np.float32)
    proposals = push_proposals(SHAPE, high, objects, goals, 40, np.random.default_rng(0))
    places = landings(SHAPE.actions(SHAPE.clip(proposals), high), high)
    assert np.nanmax(np.abs(places)) <= 0.45 + 1e-6  # where the arm stops
    assert (np.abs(places[:, 0]) > 0.08).sum() > 4


def test_proposals_begin_within_the_workspace():
    shape = SequenceShape(Limits(low=(-0.05, -0.3)))
    proposals = push_proposals(shape, np.array([0, 0, LIFTED, 0]), np.array([[0.05, 0.0]]),
                               np.array([[0.3, 0.0]]), 40, np.random.default_rng(0))
    assert (SHAPE.actions(shape.clip(proposals), np.zeros(4))[..., 0].cumsum(1) > -0.0501).all()


@pytest.mark.parametrize('limit', [0.02, 0.09, 0.15])
def test_replanning_with_small_limits_the_gripper_comes_down(limit):
    shape, gripper = SequenceShape(Limits(climb=limit)), np.array([0, 0, LIFTED, 0])
    for _ in range(12):
        parameters = np.zeros((1, SIZE))
        parameters = shape.clip(parameters, least_lift=shape.least_lift(gripper[2]))
        gripper = gripper + shape.actions(parameters, gripper)[0, 0]
    assert gripper[2] == pytest.approx(LOW, abs=1e-6)


@pytest.mark.parametrize('limits', [Limits(), Limits(low=(-0.1, -0.2), high=(0.15, 0.3))])
@pytest.mark.parametrize('start', [(0.1, 0.2), (0.44, -0.3), (-0.6, 0.5)])
def test_no_move_leads_out_of_the_workspace_or_farther_out(limits, start):
    shape, gripper = SequenceShape(limits), np.array([*start, LIFTED, 0], np.float32)
    actions = shape.actions(random_parameters(200), gripper)
    path = np.concatenate([np.tile(gripper[:2], (200, 1, 1)),
                           gripper[:2] + actions[..., :2].astype(float).cumsum(1)], 1)
    beyond = np.fmax(path - limits.high, np.array(limits.low) - path).clip(0)
    assert (np.diff(beyond, axis=1) < 1e-6).all()
    assert (np.abs(actions[..., :2]) <= shape.move_limit + 1e-6).all()
    free = SHAPE.actions(random_parameters(200), np.array([0, 0, LIFTED, 0], np.float32))
    way = free[..., :2].astype(float).cumsum(1)
    within = ((np.abs(way) < 0.449) & (gripper[:2] + way > limits.low)
              & (gripper[:2] + way < limits.high)).all((1, 2))
    assert within.any() or start != (0.1, 0.2)
    np.testing.assert_array_equal(actions[within, :, :2], free[within, :, :2])
