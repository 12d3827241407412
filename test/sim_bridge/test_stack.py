# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of stacking: towers stand by themselves, and episodes end with the release."""

import numpy as np
import pytest
from sim_bridge.collect import make_episode
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.stack import is_tower, levels, on_table, PickAndPlace
from sim_bridge.tasks.tasks import run_episode
from sim_bridge.world.scene import HALF_HEIGHT

SEEDS = range(4)


@pytest.fixture(scope='module', params=['stack2', 'stack3'])
def simulator(request):
    simulator = Simulator(request.param)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def episodes(simulator):
    return [run_episode(simulator, seed) for seed in SEEDS]


def test_most_towers_stand_and_episodes_end_with_the_release(simulator, episodes):
    assert np.mean([outcome == 'success' for *_, outcome in episodes]) >= 0.7
    for observations, actions, outcome in episodes:
        assert len(observations) == len(actions) <= simulator.task.num_frames
        if outcome == 'success':
            assert is_tower(observations[-1].object_poses)
            assert not is_tower(observations[-10].object_poses), 'the tower is not shown for long'
            opening = np.array([o.gripper[3] for o in observations])
            assert opening[-1] > 0.9 and opening[-4] < 0.9


def test_a_tower_stands_once_it_is_let_go_and_not_before(simulator, episodes):
    seed = next(s for s, (*_, outcome) in zip(SEEDS, episodes) if outcome == 'success')
    observations, actions, outcome = episodes[seed]
    release = len(actions) - 3  # the fingers open twice, then nothing is done
    assert actions[release, 3] > 0 and actions[release - 1, 3] == 0
    simulator.reset(seed)
    goal = simulator.goal()
    assert is_tower(goal.object_poses) and goal.gripper[3] > 0.9
    np.testing.assert_allclose(goal.gripper[:2], goal.object_poses[-1, :2], atol=1e-3)
    assert abs(goal.gripper[2] - goal.object_poses[-1, 2]) < HALF_HEIGHT
    for action in actions[:release]:
        simulator.step(action)
        assert simulator.outcome() == 'failure'
    for action in (*actions[release:], *[[0, 0, 0, 1]] * 2):
        simulator.step(action)
    # What is recorded as its goal shows the tower with the arm elsewhere.
    before = simulator.object_poses()
    episode = make_episode(simulator, observations, actions, outcome)
    np.testing.assert_allclose(episode.goal_poses, observations[-1].object_poses, atol=1e-6)
    assert (episode.goal_frame != observations[-1].image).any()
    simulator.step([0, 0, 0.15, 1])
    for _ in range(20):
        simulator.step([0, 0, 0, 1])
    np.testing.assert_allclose(simulator.object_poses()[:, :3], before[:, :3], atol=1e-3)
    assert simulator.outcome() == 'success'


@pytest.mark.parametrize('place', [(-0.05, 0.12), None])
def test_a_block_is_put_down_without_slipping_in_the_fingers(place):
    simulator = Simulator('stack2')
    simulator.reset(4)
    base = simulator.object_poses()[0, :3]
    below = base if place is None else on_table(np.array(place))
    held = []  # m, how high the block hangs in the fingers after each plan
    for plan in PickAndPlace(simulator, np.random.default_rng(1)).move(1, lambda: below):
        for action in plan:
            seen = simulator.step(action)
        held.append(seen.object_poses[1, 2] - seen.gripper[2])
    assert abs(held[-2] - held[-4]) < 0.003  # before the release, and after the lift
    for action in [[0, 0, 0.12, 1], [0, 0, 0, 1]]:
        simulator.step(action)
    poses = simulator.object_poses()[:, :3]
    np.testing.assert_allclose(poses[1], below + [0, 0, 2 * HALF_HEIGHT], atol=0.005)
    np.testing.assert_allclose(poses[0], base, atol=0.002)
    simulator.close()


def test_a_block_beside_the_tower_is_no_tower():
    poses = np.column_stack([np.zeros((3, 2)), HALF_HEIGHT + levels(3)])
    assert is_tower(poses)
    for offset in ([0.03, 0, 0], [0, -0.03, 0], [0, 0, 0.02], [0, 0, -0.02]):
        for k in (1, 2):
            moved = poses.copy()
            moved[k] += offset
            assert not is_tower(moved)
