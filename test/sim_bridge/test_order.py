# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the tasks whose order matters: the right one succeeds, the near one first fails."""

from itertools import pairwise

import mujoco.rollout
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.order import EDGE_RANGE, NEAR, ORDER_SEPARATION
from sim_bridge.tasks.push import GOAL_DISTANCE, nearest_first
from sim_bridge.tasks.pushes import best_push, find_order, Moment, PushRollouts
from sim_bridge.tasks.tasks import get_task, run_episode, sample_scene, task_names
from sim_bridge.world.table import GRIPPER_MARGIN, GRIPPER_RANGE
from tap_ros.contract import SUCCESS_DISTANCE

TASKS = [get_task(name) for name in task_names()]
ORDERED = [task for task in TASKS if task.ordered]
SEEDS = range(6)


@pytest.fixture(scope='module', params=ORDERED, ids=lambda task: task.name)
def simulator(request):
    simulator = Simulator(request.param.name)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def rollout():
    return mujoco.rollout.Rollout(nthread=0)


@pytest.mark.parametrize('task', ORDERED, ids=lambda task: task.name)
def test_each_object_stands_on_the_goal_of_the_one_after_it(task):
    orders = set()
    for seed in range(50):
        scene = sample_scene(task, seed)
        starts, goals = scene.start_poses[:, :2], scene.goal_poses[:, :2]
        np.testing.assert_allclose(np.linalg.norm(goals - starts, axis=1), GOAL_DISTANCE)
        assert (np.abs([starts, goals]) <= EDGE_RANGE[1]).all()
        pairs = np.triu_indices(task.num_objects, 1)
        for places in (starts, goals):
            gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
            assert (gaps[pairs] >= ORDER_SEPARATION).all()
        for before, after in pairwise(scene.order):
            assert np.linalg.norm(goals[after] - starts[before]) <= NEAR
        hand = scene.gripper_start[:2]
        assert np.linalg.norm(starts - hand, axis=1).min() >= GRIPPER_MARGIN
        assert (np.abs(hand) <= GRIPPER_RANGE).all()
        assert nearest_first(hand, starts, goals)[0] == scene.order[-1], 'the near one is last'
        orders.add(scene.order)
    assert len(orders) >= 2, 'the number of an object does not tell its turn'


@pytest.mark.parametrize('task', [t for t in TASKS if t.kind == 'push' and not t.ordered],
                         ids=lambda task: task.name)
def test_where_the_order_is_free_the_nearest_comes_first(task):
    for seed in range(5):
        scene = sample_scene(task, seed)
        starts, goals = scene.start_poses[:, :2], scene.goal_poses[:, :2]
        assert list(scene.order) == nearest_first(scene.gripper_start[:2], starts, goals)


def ends_of_pushes(simulator, rollout, seed, order):
    """Return in m how far objects end from their goals, pushed in that order, the worst again."""
    simulator.reset(seed)
    moment, goals = Moment.of(simulator), simulator.goal().object_poses[:, :3]
    rollouts, rng = PushRollouts(simulator, rollout), np.random.default_rng(seed)
    for k in order:
        moment, _ = best_push(rollouts, moment, goals, k, rng)
    worst = int(np.linalg.norm(moment.places - goals, axis=1).argmax())
    moment, _ = best_push(rollouts, moment, goals, worst, rng)
    return np.linalg.norm(moment.places - goals, axis=1)


def test_the_wrong_order_fails_and_the_right_one_succeeds(simulator, rollout):
    right, wrong = [], []
    for seed in SEEDS:
        order = sample_scene(simulator.task, seed).order
        right.append(ends_of_pushes(simulator, rollout, seed, order))
        wrong.append(ends_of_pushes(simulator, rollout, seed, order[::-1]))
    good, bad = (np.max(ends, axis=1) < SUCCESS_DISTANCE for ends in (right, wrong))
    assert good.mean() >= 0.8 and bad.mean() <= 0.2


def test_trying_all_orders_finds_what_comes_first(simulator, rollout):
    found = []
    for seed in SEEDS:
        simulator.reset(seed)
        goals = simulator.goal().object_poses[:, :3]
        order = find_order(PushRollouts(simulator, rollout), Moment.of(simulator), goals,
                           range(len(goals)), np.random.default_rng(seed))
        found.append(order[0] == simulator.scene.order[0])
    assert np.mean(found) >= 0.6, 'by chance a half, or a third'


def test_the_expert_takes_the_right_object_first(simulator):
    firsts, outcomes = [], []
    for seed in SEEDS[:3]:
        observations, _, outcome, _ = run_episode(simulator, seed)
        places = np.array([o.object_poses[:, :2] for o in observations])
        moved = np.linalg.norm(places - places[0], axis=-1) > 0.02  # (T, K)
        first = np.where(moved.any(0), moved.argmax(0), len(moved))
        firsts.append(int(first.argmin()) == simulator.scene.order[0])
        outcomes.append(outcome == 'success')
    assert np.mean(firsts) >= 0.6 and np.mean(outcomes) >= 0.5
