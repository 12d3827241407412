# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the planner, with a forward model that has not been trained."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.base.errors import ImageError, PlanningError
from tap_ros.planning.action_sequences import FULL
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.mpc_config import PRESETS, VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import Memory, Scene, VisualMPC
from tap_ros.prediction.warp import one_hot_maps
from tap_ros.weights import FORWARD_MODEL
import torch

SMALL = VisualMPCConfig(search=SearchConfig(12, 2, 4), proposals=4, batch_size=12, threads=1)
IMAGE = np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8)
GRIPPER = np.array([0.05, -0.1, 0.01, 0.0], np.float32)
PIXELS = np.array([[20.0, 17.0], [9.0, 9.0]])
GOALS = np.array([[24.0, 15.0], [9.0, 14.0]])


@pytest.fixture(scope='module')
def trained():
    return LearnedForwardModel.load(FORWARD_MODEL)


def plans(model, config=SMALL, seed=0, steps=3, limits=FULL, scale=1, **goal):
    """Return plans in a row in a scene that stays as it is, `scale` times as large."""
    mpc, memory, found = VisualMPC(model, config), Memory(seed), []
    scene = Scene(IMAGE.repeat(scale, 0).repeat(scale, 1), GRIPPER, scale * PIXELS)
    goal = mpc.goal(**(goal or {'pixels': scale * GOALS}))
    for _ in range(steps):
        found.append(mpc.plan(scene, goal, memory, limits))
        memory = found[-1].memory
    return found


def same(first, second):
    return all(np.array_equal(a.actions, b.actions) for a, b in zip(first, second))


def test_plans_are_within_limits_and_finite(model):
    for preset in PRESETS.values():
        config = replace(preset, search=SMALL.search, batch_size=12, threads=1,
                         proposals=min(4, preset.proposals))
        for plan in plans(model, config, steps=2):
            assert plan.action.shape == (4,) and plan.action.dtype == np.float32
            assert plan.actions.shape == (15, 4)
            assert np.abs(plan.action[:2]).max() <= 0.08 + 1e-6 and plan.action[3] == 0
            assert np.isfinite(plan.expected_distance)
            assert plan.elites.shape[1:] == (15, 4)
            assert any(np.array_equal(one, plan.actions) for one in plan.elites)
            assert len(np.unique(plan.elites, axis=0)) > 1, 'not all are the same'


def test_the_same_scene_goal_and_memory_give_the_same_plan_whatever_came_between(model):
    mpc, scene, memories, found = VisualMPC(model, SMALL), Scene(IMAGE, GRIPPER, PIXELS), [], []
    goal, memory = mpc.goal(GOALS), Memory()
    for _ in range(3):
        memories.append(memory)
        found.append(mpc.plan(scene, goal, memory))
        memory = found[-1].memory
    assert same(found[::-1], [mpc.plan(scene, goal, memory) for memory in memories[::-1]])
    assert not same(found[:1], found[1:2])


def test_batch_size_and_threads_change_nothing(model, trained):
    expected = plans(model)
    for changes in ({'batch_size': 5}, {'batch_size': 50}, {'threads': 2}):
        assert same(expected, plans(model, replace(SMALL, **changes)))
    assert same(*(plans(trained, replace(SMALL, batch_size=size), steps=1, scale=2)
                  for size in (12, 9)))
    costs, threads = [], torch.get_num_threads()
    try:
        for number in (1, 2):  # of torch: not one bit
            torch.set_num_threads(number)
            plan, = plans(trained, steps=1, scale=2)
            costs.append((plan.cost, plan.expected_distance))
    finally:
        torch.set_num_threads(threads)
    assert costs[0] == costs[1]


def test_a_goal_map_at_one_pixel_is_that_goal_pixel(model):
    maps = one_hot_maps(torch.tensor(GOALS), (32, 32)).numpy()
    by_map, by_pixel = plans(model, maps=3 * maps), plans(model)
    assert same(by_map, by_pixel)
    assert by_map[0].expected_distance == pytest.approx(by_pixel[0].expected_distance, abs=0.01)


def nan(values):
    values = np.array(values, float)
    values.flat[0] = np.nan
    return values


def test_a_bad_scene_or_goal_is_named(model):
    mpc, scene = VisualMPC(model, SMALL), Scene(IMAGE, GRIPPER, PIXELS)
    for wrong, name in (
            ({'image': IMAGE[:16]}, 'image'), ({'gripper': nan(GRIPPER)}, 'gripper'),
            ({'gripper': 1000 * GRIPPER}, 'expected -1 to 1'),
            ({'object_pixels': nan(PIXELS)}, r'object_pixels.*\[0\]'),
            ({'object_pixels': PIXELS[:0]}, 'object_pixels'),
            ({'object_pixels': PIXELS[:1]}, '2 goals for 1 objects')):
        with pytest.raises((ImageError, PlanningError), match=name):
            mpc.plan(replace(scene, **wrong), mpc.goal(GOALS))
    for wrong, name in (
            ({'pixels': GOALS + 30}, 'outside the 32x32 picture'),
            ({'pixels': nan(GOALS)}, r'goal_pixels.*\[0\]'), ({}, 'one of pixels and maps'),
            ({'maps': np.ones((2, 16, 32))}, r'goal_maps.*\(K, 32, 32\)'),
            ({'maps': np.zeros((2, 32, 32))}, 'goal_maps')):
        with pytest.raises((ImageError, PlanningError), match=name):
            mpc.goal(**wrong)
