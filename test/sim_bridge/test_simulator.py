# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the simulator: determinism, limits, and goals that are put elsewhere."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import run_episode
from sim_bridge.world.scene import FINGER_TRAVEL
from sim_bridge.world.table import GRIPPER_MARGIN
from tap_ros.base.contract import CONTROL_PERIOD, ROBOT_MASK_FREE, WORKSPACE_HIGH
from tap_ros.base.errors import SceneError
from tap_ros.planning.visual_mpc import GRIPPER_HIGH, GRIPPER_LOW

PLACES = np.array([[0.2, 0.1], [-0.15, -0.2]])


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2', 64)
    yield simulator
    simulator.close()


def test_the_same_actions_give_the_same_pictures_to_the_bit(simulator):
    actions = np.random.default_rng(0).uniform(-1, 1, (15, 4)) * [0.08, 0.08, 0.15, 1]
    runs = []
    for _ in range(2):
        first = simulator.reset(3)
        runs.append([first] + [simulator.step(a) for a in actions])
    for a, b in zip(*runs):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.object_poses, b.object_poses)
        assert a.stamp_ns == b.stamp_ns


def test_the_arm_goes_where_the_action_says_within_its_limits(simulator):
    before = simulator.reset(0)
    simulator.step([0, 0, 0.15, 0])
    after = simulator.step([0.05, -0.03, 0, 0])
    moved = after.gripper[:2] - before.gripper[:2]
    np.testing.assert_allclose(moved, [0.05, -0.03], atol=0.004)
    assert after.stamp_ns == round(2 * CONTROL_PERIOD * 1e9)
    for _ in range(15):
        seen = simulator.step([1, 0, 1, 0])
    np.testing.assert_allclose(seen.gripper[[0, 2]], np.take(WORKSPACE_HIGH, [0, 2]), atol=0.005)
    state = simulator.state()
    for action in ([0, 0, 0], [0, np.inf, 0, 0]):
        with pytest.raises(SceneError, match='action'):
            simulator.step(action)
    np.testing.assert_array_equal(simulator.state(), state)


def test_fingers_pressed_beyond_their_ends_are_told_as_a_planner_accepts_them(simulator):
    simulator.reset(2)
    for pressed, end in ((-0.3, 0), (1.3, 1)):
        simulator.data.qpos[3:5] = pressed * FINGER_TRAVEL
        gripper = simulator.observe().gripper
        assert (gripper >= GRIPPER_LOW).all() and (gripper <= GRIPPER_HIGH).all()
        assert abs(gripper[3] - end) == pytest.approx(0.1)


def test_a_dropped_simulator_leaves_the_pictures_of_others_alone(simulator):
    before = simulator.reset(3).image
    other = Simulator('push2')
    other.reset(4)
    simulator.observe()  # whose context is the current one when the other is dropped
    del other
    np.testing.assert_array_equal(simulator.observe().image, before)
    made = [Simulator('push2')]
    made[0].reset(5)
    with ThreadPoolExecutor(1) as pool:  # in a thread that cannot draw with that context
        pool.submit(made.clear).result()
    np.testing.assert_array_equal(simulator.observe().image, before)


def test_distances_outcome_and_pictures_follow_the_goal(simulator):
    start = simulator.reset(3)
    before, drawn = simulator.goal(), simulator.scene
    simulator.set_goal(PLACES)
    goal, bare = simulator.goal(), simulator.goal(hide_arm=True)
    assert simulator.scene is drawn
    for seen in (goal, bare):
        np.testing.assert_allclose(seen.object_poses[:, :2], PLACES)
        np.testing.assert_allclose(  # heights and yaws
            seen.object_poses[:, 2:], before.object_poses[:, 2:], atol=1e-12)
        assert (seen.image != before.image).any()
    assert (goal.robot_mask != ROBOT_MASK_FREE).any() and (goal.image != bare.image).any()
    assert (bare.robot_mask == ROBOT_MASK_FREE).all()
    assert np.linalg.norm(PLACES - goal.gripper[:2], axis=1).min() > GRIPPER_MARGIN
    np.testing.assert_allclose(simulator.distances(), np.linalg.norm(
        PLACES - start.object_poses[:, :2], axis=1), atol=1e-6)
    assert simulator.outcome() == 'failure'
    simulator.set_goal(start.object_poses[:, :2])
    np.testing.assert_allclose(simulator.distances(), 0, atol=1e-6)
    assert simulator.outcome() == 'success'
    simulator.reset(3)
    np.testing.assert_array_equal(simulator.goal().image, before.image)


def test_nothing_moves_to_the_bit_also_while_the_arm_pushes(simulator):
    actions, runs = run_episode(simulator, 3)[1][:25], []
    for moved in (False, True):
        simulator.reset(3)
        run = []
        for action in actions:
            run.append(simulator.step(action))
            if moved:
                simulator.set_goal(PLACES)
                simulator.photograph(simulator.goal_poses)
                with pytest.raises(SceneError):
                    simulator.set_goal(np.zeros((2, 2)))
                np.testing.assert_array_equal(simulator.observe().image, run[-1].image)
        runs.append(run)
    assert np.abs(runs[0][-1].object_poses - runs[0][0].object_poses).max() > 0.03, 'it pushes'
    for a, b in zip(*runs):
        for field in ('image', 'object_poses', 'gripper'):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
        assert a.stamp_ns == b.stamp_ns


def test_a_goal_that_cannot_be_is_refused_and_the_old_one_stays(simulator):
    simulator.reset(3)
    simulator.set_goal(PLACES)
    before, state = simulator.goal(), simulator.state()
    for places, words in (
            (PLACES[:1], r'shape \(2, 2\), got \(1, 2\)'),
            ([[0.2, 0.1], [0.1, -0.351]], 'object_1 is out .*: 1 cm too near; .* 35 cm'),
            ([[0.36, 0.1], [-0.4, 0.46]], 'object_0 is out of reach: 1 cm too far right;'),
            ([[0.1, 0.1], [-0.4, 0.46]], 'object_1 .*: 5 cm too far left, 11 cm too far away;'),
            ([[np.nan, 0.1], [0.1, 0.1]], 'object_0 is not on the table'),
            ([[0.1, 0.1], [0.1, np.inf]], 'object_1 is not on the table'),
            ([[0.1, 0.1], [0.1, 0.1]], 'object_0 and object_1 would overlap')):
        with pytest.raises(SceneError, match=words):
            simulator.set_goal(places)
    for unfit, words in (((), 'empty.*object_0'), (('cup',), 'cup.*object_0, object_1')):
        with pytest.raises(SceneError, match=words):
            simulator.move_goal(unfit, np.zeros((len(unfit), 2)))
    assert simulator.goal() is before
    np.testing.assert_array_equal(simulator.state(), state)
