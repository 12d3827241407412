# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the scenes of all tasks: start and goal rules, cameras, determinism."""

from itertools import pairwise

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.grasp import PLACE_DISTANCE
from sim_bridge.tasks.order import NEAR
from sim_bridge.tasks.push import GOAL_DISTANCE, nearest_first
from sim_bridge.tasks.stack import HAND_MARGIN
from sim_bridge.tasks.tasks import get_task, sample_scene, task_names
from sim_bridge.world.table import GRIPPER_MARGIN
from tap_ros.base.contract import WORKSPACE_HIGH
from tap_ros.base.errors import SceneError

TASKS = [get_task(name) for name in task_names()]


@pytest.mark.parametrize('task', TASKS, ids=lambda task: task.name)
def test_scenes_obey_the_rules_of_their_task(task):
    orders = set()
    for seed in range(50):
        scene = sample_scene(task, seed)
        orders.add(scene.order)
        starts, goals = scene.start_poses[:, :2], scene.goal_poses[:, :2]
        hand, moved = scene.gripper_start[:2], np.linalg.norm(goals - starts, axis=1)
        assert (np.abs([*starts, *goals, hand]) <= WORKSPACE_HIGH[0]).all()
        away = np.linalg.norm(starts - hand, axis=1).min()
        if task.kind == 'push':
            np.testing.assert_allclose(moved, GOAL_DISTANCE)
            assert away >= GRIPPER_MARGIN
            first = nearest_first(hand, starts, goals)
            assert first[0] == scene.order[-1] if task.ordered else first == list(scene.order)
        if task.ordered:
            for before, after in pairwise(scene.order):
                assert np.linalg.norm(goals[after] - starts[before]) <= NEAR
        if task.kind == 'pick_place':
            assert PLACE_DISTANCE[0] <= moved[0] <= PLACE_DISTANCE[1]
        if task.kind == 'stack':
            assert away >= HAND_MARGIN and (goals == starts[0]).all()
    if task.kind == 'push':
        assert len(orders) >= 2, 'the number of an object does not tell its turn'


def test_a_scene_follows_from_task_and_seed():
    assert len({task.stream for task in TASKS}) == len(TASKS)
    push2 = get_task('push2')
    first, again, other = (sample_scene(push2, seed) for seed in (5, 5, 6))
    assert first.shapes == again.shapes
    np.testing.assert_array_equal(first.start_poses, again.start_poses)
    assert not np.allclose(first.start_poses, other.start_poses)
    # Recordings are named by seed: a change here makes them impossible to collect again.
    np.testing.assert_allclose(
        sample_scene(push2, 500000).start_poses,
        [[-0.2823144, 0.1070191, 1.0756113], [0.1355647, -0.047126, 1.3841829]], atol=1e-6)
    for seed in (-1, 1.5, 'a', None):
        with pytest.raises(SceneError, match='seed'):
            sample_scene(push2, seed)
    with pytest.raises(SceneError, match='push2, push3'):
        Simulator('juggle')
