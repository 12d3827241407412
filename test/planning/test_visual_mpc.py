# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the planner, with a forward model that has not been trained."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.errors import ConfigError, PlanningError
from tap_ros.images import to_float
from tap_ros.planning.action_sequences import HORIZON
from tap_ros.planning.cem import CEMConfig
from tap_ros.planning.mpc_config import PRESETS, VisualMPCConfig, with_preset
from tap_ros.planning.visual_mpc import landing_clash, LAST_WEIGHT, VisualMPC
from tap_ros.prediction.warp import one_hot_maps
from tap_ros.weights import FORWARD_MODEL
import torch

SMALL = VisualMPCConfig(search=CEMConfig(24, 2, 5), proposals=8, batch_size=24, threads=1)
IMAGE = np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8)
GRIPPER = np.array([0.05, -0.1, 0.01, 0.0], np.float32)
PIXELS = np.array([[20.0, 17.0], [9.0, 9.0]])
DISTANCE = np.random.default_rng(1).uniform(0, 30, (2, 44 * 44))  # px, of each table cell
GOALS = np.array([[24.0, 15.0], [9.0, 14.0]])


def plans(model, config=SMALL, seed=0, steps=3, **goal):
    mpc = VisualMPC(model, config)
    mpc.reset(seed)
    goal = goal or {'goal_pixels': GOALS}
    return [mpc.act(IMAGE, GRIPPER, PIXELS, **goal) for _ in range(steps)]


def same(first, second):
    return all(np.array_equal(a.actions, b.actions) for a, b in zip(first, second))


@pytest.mark.parametrize('preset', PRESETS)
def test_plans_are_within_limits_and_finite(model, preset):
    config = replace(PRESETS[preset], search=SMALL.search, batch_size=24, threads=1,
                     proposals=min(8, PRESETS[preset].proposals))
    for plan in plans(model, config, steps=4):
        assert plan.action.shape == (4,) and plan.action.dtype == np.float32
        assert plan.actions.shape == (15, 4)
        assert np.abs(plan.action[:2]).max() <= 0.08 + 1e-6 and plan.action[3] == 0
        assert np.isfinite([plan.expected_distance, plan.current_distance]).all()


def test_same_seed_same_plans_and_another_seed_others(model):
    assert same(plans(model), plans(model))
    assert not same(plans(model), plans(model, seed=1))


def test_reset_forgets_the_last_plan(model):
    mpc = VisualMPC(model, SMALL)
    first = mpc.act(IMAGE, GRIPPER, PIXELS, goal_pixels=GOALS)
    mpc.act(IMAGE, GRIPPER, PIXELS, goal_pixels=GOALS)
    mpc.reset(0)
    assert same([first], [mpc.act(IMAGE, GRIPPER, PIXELS, goal_pixels=GOALS)])


@pytest.mark.parametrize('changes', [{'batch_size': 5}, {'batch_size': 50}, {'threads': 2}])
def test_batch_size_and_threads_change_nothing(model, changes):
    assert same(plans(model), plans(model, replace(SMALL, **changes)))


def test_elites_judged_again_from_the_same_place_rank_as_before(monkeypatch):
    def chosen(**changes):
        mpc = VisualMPC.load(FORWARD_MODEL, replace(SMALL, **changes))
        image = IMAGE.repeat(2, 0).repeat(2, 1)
        return [mpc.act(image, GRIPPER, 2 * PIXELS, goal_pixels=2 * GOALS) for _ in range(4)]

    assert same(chosen(recheck=0), chosen(recheck=1))
    monkeypatch.setattr('tap_ros.planning.visual_mpc.RECHECK_STD', 0.02)
    assert not same(chosen(recheck=0), chosen(recheck=4))


@pytest.mark.parametrize('batch_size', [32, 50])
def test_trained_weights_plan_the_same_in_any_batch(batch_size):
    image = IMAGE.repeat(2, 0).repeat(2, 1)

    def chosen(batch_size):
        mpc = VisualMPC.load(FORWARD_MODEL, with_preset('default', batch_size=batch_size))
        return mpc.act(image, GRIPPER, 2 * PIXELS, goal_pixels=2 * GOALS)

    assert same([chosen(64)], [chosen(batch_size)])


def test_the_planner_stays_within_limits_that_are_set(model):
    mpc = VisualMPC(model, SMALL)
    mpc.limit(0.02, 0.05)
    mpc.reset(0)
    actions = np.concatenate([
        mpc.act(IMAGE, GRIPPER, PIXELS, goal_pixels=GOALS).actions for _ in range(3)])
    assert 0.01 < np.abs(actions[:, :2]).max() <= 0.02 + 1e-6
    assert np.abs(actions[:, 2]).max() <= 0.05 + 1e-6
    mpc.limit(1.0, 1.0)
    mpc.reset(0)
    assert same(plans(model), [mpc.act(IMAGE, GRIPPER, PIXELS, goal_pixels=GOALS)
                               for _ in range(3)])


def test_an_object_that_the_flow_loses_is_dear(model):
    mpc = VisualMPC(model, SMALL)
    lost = torch.zeros(24, 2, 44, 44)
    model.carried_maps = lambda *_: iter([lost])
    costs, _ = mpc._cost(None, torch.zeros(1, 4), None, torch.from_numpy(DISTANCE).float(),
                         np.zeros((24, 15, 4), np.float32))
    assert (costs >= 10 * DISTANCE.max(1).sum() - 0.1).all()


@pytest.mark.parametrize('count, lengths', [(48, {24}), (64, {32}), (33, {17}), (1, {1})])
def test_sequences_are_predicted_in_even_batches(model, monkeypatch, count, lengths):
    seen, carried_maps = [], model.carried_maps

    def spy(features, begin, maps, actions, *rest):
        seen.append(len(actions))
        return carried_maps(features, begin, maps, actions, *rest)

    monkeypatch.setattr(model, 'carried_maps', spy)
    mpc = VisualMPC(model, replace(SMALL, batch_size=32))
    costs, _ = mpc._cost(
        model.begin(to_float(IMAGE)[None], torch.zeros(1, 4)), torch.zeros(1, 4),
        model.seed_maps(torch.tensor(PIXELS).float()), torch.from_numpy(DISTANCE).float(),
        np.zeros((count, 15, 4), np.float32))
    assert len(costs) == count and set(seen) == lengths


def test_equal_sequences_cost_the_same_in_any_batch(model):
    costs, actions = {}, np.zeros((40, 15, 4), np.float32)
    actions[..., :2] = np.random.default_rng(0).normal(0, 0.05, (5, 15, 2)).repeat(8, 0)
    features = model.begin(to_float(IMAGE)[None], torch.zeros(1, 4))
    maps = model.seed_maps(torch.tensor(PIXELS).float())
    for size in (1, 3, 7, 40):
        mpc = VisualMPC(model, replace(SMALL, batch_size=size))
        costs[size], _ = mpc._cost(features, torch.zeros(1, 4), maps,
                                   torch.from_numpy(DISTANCE).float(), actions)
        assert (costs[size].reshape(5, 8) == costs[size][::8, None]).all()
    assert len({values.tobytes() for values in costs.values()}) == 1
    assert len(set(costs[40])) == 5


def test_current_distance_is_that_of_the_pixels(model):
    expected = np.linalg.norm(PIXELS - GOALS, axis=1).mean()
    assert plans(model)[0].current_distance == pytest.approx(expected, rel=0.05)


def test_a_goal_map_at_one_pixel_is_that_goal_pixel(model):
    maps = one_hot_maps(torch.tensor(GOALS), (32, 32)).numpy()
    by_map, by_pixel = plans(model, goal_maps=3 * maps), plans(model)
    assert same(by_map, by_pixel)
    assert by_map[0].expected_distance == pytest.approx(by_pixel[0].expected_distance, abs=0.01)


def test_more_samples_never_plan_worse_on_average(model):
    few = replace(SMALL, search=CEMConfig(8, 1, 2))
    worse = [plans(model, few, seed, 1)[0].expected_distance for seed in range(4)]
    better = [plans(model, seed=seed, steps=1)[0].expected_distance for seed in range(4)]
    assert np.mean(better) <= np.mean(worse)


def test_coming_down_upon_an_object_costs_more_than_any_push():
    landings = np.array([[0.0, 0.0], [0.3, 0.0], [np.nan, np.nan]])
    cost = landing_clash(landings, np.array([[0.02, 0.0], [-0.3, 0]]), 0.08)
    assert cost[0] > 64 and not cost[1:].any()
    assert not landing_clash(landings, np.zeros((1, 2)), 0.0).any()


def nan(values):
    values = np.array(values, float)
    values.flat[0] = np.nan
    return values


@pytest.mark.parametrize('wrong, name', [
    ({'image': IMAGE[:16]}, 'image'),
    ({'image': IMAGE.astype(np.float32)}, 'image'),
    ({'gripper': GRIPPER[:3]}, 'gripper'),
    ({'gripper': nan(GRIPPER)}, 'gripper'),
    ({'gripper': 1000 * GRIPPER}, 'expected -1 to 1'),
    ({'gripper': GRIPPER - np.float32([0, 0, 5, 0])}, 'z is -4.* expected -0.1 to 1'),
    ({'gripper': GRIPPER + np.float32([0, 0, 0, 1e9])}, 'opening is 1e.09'),
    ({'object_pixels': nan(PIXELS)}, r'object_pixels.*\[0\]'),
    ({'object_pixels': PIXELS[0]}, 'object_pixels'),
    ({'object_pixels': PIXELS[:0]}, 'object_pixels'),
    ({'goal_pixels': GOALS[:1]}, '1 goals for 2 objects'),
    ({'goal_pixels': GOALS + 30}, 'outside the 32x32 picture'),
    ({'goal_pixels': None}, 'goal_maps and goal_pixels'),
    ({'goal_pixels': None, 'goal_maps': np.ones((1, 32, 32))}, 'goal_maps.*(2, 32, 32)'),
    ({'goal_pixels': None, 'goal_maps': np.zeros((2, 32, 32))}, 'goal_maps'),
    ({'goal_pixels': None, 'goal_maps': nan(np.ones((2, 32, 32)))}, 'goal_maps'),
])
def test_bad_input_is_named(model, wrong, name):
    inputs = {'image': IMAGE, 'gripper': GRIPPER, 'object_pixels': PIXELS, 'goal_pixels': GOALS}
    with pytest.raises(PlanningError, match=name.replace('(2, 32, 32)', '')):
        VisualMPC(model, SMALL).act(**(inputs | wrong))


@pytest.mark.parametrize('wrong, name', [
    ({'cost_every': 4}, 'cost_every'),
    ({'proposals': 500}, 'proposals'), ({'replan_every': 0}, 'replan_every'),
    ({'replan_every': 16}, 'replan_every'), ({'recheck': -1}, 'recheck'),
    ({'batch_size': 0}, 'batch_size')])
def test_impossible_settings_are_named(wrong, name):
    with pytest.raises(ConfigError, match=name):
        VisualMPCConfig(**wrong)


def test_paper_preset_has_the_papers_numbers():
    paper = with_preset('paper')
    assert (paper.search.num_samples, paper.search.num_iterations, paper.search.num_elites) == (
        200, 3, 10)
    assert HORIZON == 15 and LAST_WEIGHT == 10
    assert not paper.warm_start and not paper.proposals
    assert not paper.free_phase and not paper.recheck
    with pytest.raises(ConfigError, match='default, large, paper'):
        with_preset('fast')
