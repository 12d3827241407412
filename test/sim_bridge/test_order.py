# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the tasks whose order matters: the right one succeeds, the near one first fails."""

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.pushes import best_push, find_order, Moment
from sim_bridge.tasks.tasks import run_episode, sample_scene
from tap_ros.contract import SUCCESS_DISTANCE

SEEDS = range(5)


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('order2')
    yield simulator
    simulator.close()


def ends_of_pushes(simulator, seed, order):
    """Return in m how far objects end from their goals, pushed in that order, the worst again."""
    simulator.reset(seed)
    moment, goals = Moment.of(simulator), simulator.goal_poses[:, :3]
    rng = np.random.default_rng(seed)
    for k in order:
        moment, _ = best_push(simulator, moment, goals, k, rng)
    worst = int(np.linalg.norm(moment.places - goals, axis=1).argmax())
    moment, _ = best_push(simulator, moment, goals, worst, rng)
    return np.linalg.norm(moment.places - goals, axis=1)


def test_the_wrong_order_fails_and_the_right_one_is_found_and_succeeds(simulator):
    right, wrong, found = [], [], []
    for seed in SEEDS:
        order = sample_scene(simulator.task, seed).order
        right.append(ends_of_pushes(simulator, seed, order))
        wrong.append(ends_of_pushes(simulator, seed, order[::-1]))
        simulator.reset(seed)
        goals = simulator.goal_poses[:, :3]
        best = find_order(simulator, Moment.of(simulator), goals, range(len(goals)),
                          np.random.default_rng(seed))
        found.append(best[0] == order[0])
    good, bad = (np.max(ends, axis=1) < SUCCESS_DISTANCE for ends in (right, wrong))
    assert good.mean() >= 0.8 and bad.mean() <= 0.2
    assert np.mean(found) >= 0.6, 'by chance a half'


def test_the_expert_takes_the_right_object_first(simulator):
    firsts, outcomes = [], []
    for seed in SEEDS[:2]:
        observations, _, outcome = run_episode(simulator, seed)
        places = np.array([o.object_poses[:, :2] for o in observations])
        moved = np.linalg.norm(places - places[0], axis=-1) > 0.02  # (T, K)
        first = np.where(moved.any(0), moved.argmax(0), len(moved))
        firsts.append(int(first.argmin()) == simulator.scene.order[0])
        outcomes.append(outcome == 'success')
    assert all(firsts) and any(outcomes)
