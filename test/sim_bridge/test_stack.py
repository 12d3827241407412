# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of stacking: towers stand by themselves, and episodes end with the release."""

import mujoco.rollout
import numpy as np
import pytest
from sim_bridge.collect import make_episode
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.stack import (
    BLOCK_RANGE,
    BLOCK_SEPARATION,
    HAND_MARGIN,
    is_tower,
    levels,
    on_table,
    PickAndPlace,
    STACK_CONFIG,
)
from sim_bridge.tasks.tasks import get_task, run_episode, sample_scene, task_names
from sim_bridge.world.scene import HALF_HEIGHT

STACKING = [task for task in map(get_task, task_names()) if task.kind == 'stack']
SEEDS = range(8)


@pytest.fixture(scope='module', params=STACKING, ids=lambda task: task.name)
def simulator(request):
    simulator = Simulator(request.param.name)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def episodes(simulator):
    return [run_episode(simulator, seed)[:3] for seed in SEEDS]


@pytest.mark.parametrize('task', STACKING, ids=lambda task: task.name)
def test_blocks_start_apart_and_the_tower_is_on_the_first(task):
    pairs = np.triu_indices(task.num_objects, 1)
    for seed in range(50):
        scene = sample_scene(task, seed)
        starts = scene.start_poses[:, :2]
        assert (np.abs(starts) <= BLOCK_RANGE).all()
        gaps = np.linalg.norm(starts[:, None] - starts[None], axis=-1)
        assert gaps[pairs].min() >= BLOCK_SEPARATION
        assert np.linalg.norm(starts - scene.gripper_start[:2], axis=1).min() >= HAND_MARGIN
        assert (scene.goal_poses[:, :2] == starts[0]).all()
        np.testing.assert_array_equal(scene.goal_poses[0], scene.start_poses[0])


def test_most_towers_stand_and_episodes_end_with_the_release(simulator, episodes):
    assert np.mean([outcome == 'success' for *_, outcome in episodes]) >= 0.7
    for observations, actions, outcome in episodes:
        assert len(observations) == len(actions) <= simulator.task.num_frames
        if outcome == 'success':
            assert is_tower(observations[-1].object_poses)
            assert not is_tower(observations[-10].object_poses), 'the tower is not shown for long'
            opening = np.array([o.gripper[3] for o in observations])
            assert opening[-1] > 0.9 and opening[-4] < 0.9


def test_a_tower_that_was_built_stands(simulator, episodes):
    seed = next(s for s, (*_, outcome) in zip(SEEDS, episodes) if outcome == 'success')
    run_episode(simulator, seed)
    simulator.step([0, 0, 0.15, 1])
    before = simulator.object_poses()
    for _ in range(20):
        simulator.step([0, 0, 0, 1])
    np.testing.assert_allclose(simulator.object_poses()[:, :3], before[:, :3], atol=1e-3)
    assert simulator.outcome() == 'success'


def test_a_block_that_is_held_above_the_tower_is_not_on_it(simulator, episodes):
    seed = next(s for s, (*_, outcome) in zip(SEEDS, episodes) if outcome == 'success')
    actions = episodes[seed][1]
    release = len(actions) - 3  # the fingers open twice, then nothing is done
    assert actions[release, 3] > 0 and actions[release - 1, 3] == 0
    simulator.reset(seed)
    for action in actions[:release]:
        simulator.step(action)
        assert simulator.outcome() == 'failure'


def test_the_goal_is_a_tower_with_the_open_gripper_at_its_top(simulator):
    simulator.reset(1)
    goal = simulator.goal()
    assert is_tower(goal.object_poses)
    assert goal.gripper[3] > 0.9
    np.testing.assert_allclose(goal.gripper[:2], goal.object_poses[-1, :2], atol=1e-3)
    assert abs(goal.gripper[2] - goal.object_poses[-1, 2]) < HALF_HEIGHT
    assert (goal.image != simulator.goal(hide_arm=True).image).any()
    assert simulator.outcome() == 'failure', 'nothing is done yet'


def test_a_recorded_goal_shows_the_tower_with_the_arm_elsewhere(simulator, episodes):
    observations, actions, outcome = episodes[1]
    run_episode(simulator, 1)  # the simulator is where this episode ended
    episode = make_episode(simulator, observations, actions, outcome)
    np.testing.assert_allclose(episode.goal_poses, observations[-1].object_poses, atol=1e-6)
    assert (episode.goal_frame != observations[-1].image).any()


@pytest.mark.parametrize('place', [(-0.05, 0.12), (0.1, -0.1), None])
def test_a_block_is_put_down_without_slipping_in_the_fingers(place):
    simulator = Simulator('stack2')
    try:
        simulator.reset(4)
        mover = PickAndPlace(simulator, np.random.default_rng(1), STACK_CONFIG,
                             mujoco.rollout.Rollout(nthread=0))
        base = simulator.object_poses()[0, :3]
        below = base if place is None else on_table(np.array(place))
        held = []  # m, how high the block hangs in the fingers after each plan
        for plan in mover.move(1, lambda: below):
            for action in plan:
                seen = simulator.step(action)
            held.append(seen.object_poses[1, 2] - seen.gripper[2])
        assert abs(held[-2] - held[-4]) < 0.003  # before the release, and after the lift
        for action in [[0, 0, 0.12, 1], [0, 0, 0, 1]]:
            simulator.step(action)
        poses = simulator.object_poses()[:, :3]
        np.testing.assert_allclose(poses[1], below + [0, 0, 2 * HALF_HEIGHT], atol=0.005)
        np.testing.assert_allclose(poses[0], base, atol=0.002)
    finally:
        simulator.close()


@pytest.mark.parametrize('offset', [[0.03, 0, 0], [0, -0.03, 0], [0, 0, 0.02], [0, 0, -0.02]])
def test_a_block_beside_the_tower_is_no_tower(offset):
    poses = np.column_stack([np.zeros((3, 2)), HALF_HEIGHT + levels(3)])
    assert is_tower(poses)
    for k in (1, 2):
        moved = poses.copy()
        moved[k] += offset
        assert not is_tower(moved)
