# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the planning evaluation, in the real simulator with the shipped forward model."""

import json

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from tap_ros.errors import ConfigError
from tap_ros.evaluation.planning import evaluate_planning, run_episode, summarise, WEIGHTS
from tap_ros.images import to_float
from tap_ros.planning.cem import CEMConfig
from tap_ros.planning.visual_mpc import VisualMPC, VisualMPCConfig
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.warp import one_hot_maps
import torch

QUICK = VisualMPCConfig(search=CEMConfig(16, 1, 4), proposals=8, batch_size=16, threads=1)


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def mpc():
    return VisualMPC.load(WEIGHTS / 'forward_model_push.safetensors', QUICK)


@pytest.fixture(scope='module')
def predictor():
    return SubgoalPredictor.load(WEIGHTS / 'predictor_push.safetensors')


def test_doing_nothing_ends_20_cm_away(simulator, mpc):
    run = run_episode(simulator, mpc, None, 'nothing', 10, seed=5)
    np.testing.assert_allclose(run.distances, 0.2, atol=1e-3)
    assert len(run.frames) == 1 and not len(run.actions)


def test_the_same_seed_repeats_an_episode(simulator, mpc):
    first, second = (run_episode(simulator, mpc, None, 'direct', 3, seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.actions, second.actions)
    np.testing.assert_array_equal(first.distances, second.distances)
    assert first.distances.shape == (4, 2) and len(first.frames) == 4


def test_the_goal_follows_the_subgoal_at_half_the_budget(simulator, mpc, predictor):
    run = run_episode(simulator, mpc, predictor, 'subgoal', 4, seed=5)
    assert run.switched_at == 2 and len(run.actions) == 4
    at_once = run_episode(simulator, mpc, predictor, 'subgoal', 4, seed=5, reached=30.0)
    assert not len(at_once.actions)  # 20 cm are less than 30 px: already there


def test_unknown_modes_and_missing_predictors_are_named(simulator, mpc):
    with pytest.raises(ConfigError, match='nothing, direct, subgoal'):
        run_episode(simulator, mpc, None, 'both', 4, seed=5)
    with pytest.raises(ConfigError, match='predictor'):
        run_episode(simulator, mpc, None, 'subgoal', 4, seed=5)


def test_an_evaluation_goes_on_where_it_stopped(simulator, mpc, tmp_path):
    out = tmp_path / 'planning.json'
    settings, modes = {'step_budget': 2}, ['nothing', 'direct']

    def evaluate(seeds):
        return evaluate_planning(
            simulator, mpc, None, modes, seeds, 2, out, settings, progress=False)

    first = evaluate([7])
    stored = json.loads(out.read_text())
    stored['episodes'][0]['final_cm'] = 99.0  # to see that it is not run again
    out.write_text(json.dumps(stored))
    both = evaluate([7, 8])
    assert len(first) == 2 and len(both) == 4 and both[0]['final_cm'] == 99.0
    with pytest.raises(ConfigError, match='other settings'):
        evaluate_planning(
            simulator, mpc, None, modes, [7], 3, out, {'step_budget': 3}, progress=False)


def test_summary_averages_and_pairs_scenes():
    episodes = [
        {'seed': seed, 'mode': mode, 'final_cm': cm, 'objects_cm': [cm, cm], 'planning_ms': 5.0}
        for mode, finals in (('direct', (10.0, 14.0)), ('subgoal', (4.0, 10.0)))
        for seed, cm in enumerate(finals)]
    table = summarise(episodes)
    assert table['direct']['mean_cm'] == 12 and table['subgoal']['mean_cm'] == 7
    assert table['subgoal']['success_5cm'] == 0.5
    assert table['subgoal']['gain_cm'] == 5
    assert table['subgoal']['gain_standard_error_cm'] == pytest.approx(1.0)
    assert 'nothing' not in table


def test_shipped_model_foresees_a_push(simulator, mpc):
    errors, moves = [], []
    for seed in range(30, 34):
        seen = simulator.reset(seed)
        target = seen.object_poses[0, :2]
        along = -target / np.linalg.norm(target)  # towards the middle of the table
        behind = target - 0.13 * along
        for _ in range(14):
            gap = behind - seen.gripper[:2]
            seen = simulator.step([*gap, 0.13 - seen.gripper[2], 0])
            if np.abs(gap).max() < 0.005:
                break
        seen = simulator.step([0, 0, 0.012 - seen.gripper[2], 0])
        actions = np.tile(np.append(0.035 * along, [0, 0]), (1, 7, 1)).astype(np.float32)
        maps = one_hot_maps(torch.from_numpy(seen.object_pixels), (64, 64))[None]
        predicted = mpc.model.rollout(
            to_float(seen.image)[None], torch.from_numpy(seen.gripper)[None], maps,
            torch.from_numpy(actions))[0, -1].numpy()
        before = seen.object_pixels
        for action in actions[0]:
            seen = simulator.step(action)
        errors.append(np.linalg.norm(predicted[0] - seen.object_pixels[0]))
        moves.append(np.linalg.norm(before[0] - seen.object_pixels[0]))
    assert np.mean(moves) > 4 and np.mean(errors) < 0.5 * np.mean(moves)
