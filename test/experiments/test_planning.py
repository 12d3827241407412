# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of planned episodes, in the real simulator with the shipped weights."""

import copy
from dataclasses import replace

from experiments.planning.episode import make_targets, run_episode
from experiments.planning.methods import BASES, parse_method
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from sim_bridge.true_model import TrueModel
from tap_ros.base.errors import ConfigError
from tap_ros.images.pixels import to_float
from tap_ros.images.robot_mask import FreeView
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL

SMALL = VisualMPCConfig(search=SearchConfig(16, 1, 4), proposals=8, batch_size=16, threads=1)
DIRECT, SHIPPED = parse_method('direct'), parse_method('shipped')


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2', 64)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def mpc():
    return VisualMPC.load(FORWARD_MODEL, SMALL)


@pytest.fixture(scope='module')
def predictor():
    return SubgoalPredictor.load(DEFAULT_PREDICTOR)


def test_the_goal_follows_the_subgoal_at_half_the_budget(simulator, mpc, predictor):
    run = run_episode(simulator, mpc, SHIPPED, 4, 5, predictor)
    assert run.switches == [2] and len(run.actions) == 4
    at_once = run_episode(simulator, mpc, SHIPPED, 4, 5, predictor, reached=30.0)
    assert not len(at_once.actions)  # 20 cm are less than 30 px: already there


def test_the_true_subgoal_has_the_nearest_object_at_its_goal(simulator, mpc):
    seen = simulator.reset(5)
    goal = simulator.goal()
    targets, _ = make_targets(simulator, mpc, parse_method('true_subgoal'), seen, goal, None, 5)
    moved = np.linalg.norm(targets[0].pixels - seen.object_pixels, axis=1) > 1
    gaps = np.linalg.norm(seen.object_poses[:, :2] - seen.gripper[:2], axis=1)
    assert moved.tolist() == (gaps == gaps.min()).tolist()
    np.testing.assert_array_equal(targets[0].pixels[moved], goal.object_pixels[moved])
    np.testing.assert_array_equal(targets[1].pixels, goal.object_pixels)
    oracle, _ = make_targets(simulator, mpc, parse_method('oracle_order'), seen, goal, None, 5)
    assert oracle[0].free.tolist() == (~moved).tolist() and oracle[1].free is None


class Witness:
    """A predictor that keeps the pictures it is shown."""

    def __init__(self, predictor, robot_mask, fill_context):
        self._predictor, self.shown = predictor, []
        settings = {'robot_mask': robot_mask, 'fill_context': fill_context}
        self.training = {'settings': settings}

    def predict(self, *pictures, **how):
        self.shown += pictures[:2]
        return self._predictor.predict(*pictures, **how)


def test_networks_are_shown_what_nodes_would_show(mpc, predictor):
    studio, robot_mask = Simulator('push2', 64, look='hand'), 'all'
    model = copy.copy(mpc.model)
    model.config = replace(model.config, robot_mask=robot_mask)
    seen_by_model, begin = [], model.begin
    model.begin = lambda image, *rest: (seen_by_model.append(image), begin(image, *rest))[1]
    witness = Witness(predictor, robot_mask, 1)
    run = run_episode(studio, VisualMPC(model, SMALL), SHIPPED, 3, 5, witness)
    view = FreeView(robot_mask)
    expected = [view.update(seen.image, seen.robot_mask) for seen in run.observations]
    for image, picture in zip(seen_by_model[-3:], expected):
        np.testing.assert_array_equal(image[0], to_float(picture))
    first, goal, start = FreeView(robot_mask), run.goal, run.observations[0]
    np.testing.assert_array_equal(witness.shown[0], first.update(start.image, start.robot_mask))
    np.testing.assert_array_equal(witness.shown[1], first.fill(goal.image, goal.robot_mask))
    assert (expected[-1] != run.frames[-1]).any()
    studio.close()


def test_planning_with_the_true_model_runs_and_repeats(simulator, mpc):
    method = parse_method('true_model')
    planner = VisualMPC(TrueModel(mpc.model.table, simulator), method.planner(SMALL))
    runs = [run_episode(simulator, planner, method, 2, 5) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].actions, runs[1].actions)


def test_the_name_of_a_method_reads_as_that_method():
    for text in (*BASES, 'true_model', 'genmin:rounds3:tracked', 'direct:tracked',
                 'fix0.25:recursion2:samples8:tracked', 'genmin+progress-r2:recursion2'):
        method = parse_method(text)
        assert parse_method(method.name) == method and method.predicted == (
            text.split(':')[0] not in (*BASES, 'true_model'))
        assert ':' not in method.file_name


def test_impossible_methods_are_named(simulator, mpc):
    for text in ('genmin:often', 'genmin:recursion0', 'a b', 'genmin:samples2:true_model'):
        with pytest.raises(ConfigError, match=text):
            parse_method(text)
    old = parse_method('shipped:stalled')  # of results that were made before
    with pytest.raises(ConfigError, match="'stalled' is unknown"):
        run_episode(simulator, mpc, replace(old, base='direct'), 4, 5)
