# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A solver, a forward model and a cost of one's own drive the planner and the control loop."""

from importlib.metadata import EntryPoint
from math import inf
import time

import numpy as np
import pytest
import tap_ros
from tap_ros import VisualMPC
from tap_ros.base import plugins
from tap_ros.base.errors import ConfigError, WeightsError
from tap_ros.planning.cost import PlanCost
from tap_ros.planning.hierarchy import Target
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import Problem, SearchConfig, Solution
from tap_ros.planning.reach import Command, End, Observation, Reach, ReachConfig, SelectTargets
from tap_ros.planning.visual_mpc import Scene
from toy_world import SCALE, SIZE, Telekinesis

START, GOAL = np.array([[8.0, 20.0]], np.float32), np.array([[20.0, 12.0]], np.float32)


def best_of_some(problem: Problem, config: SearchConfig, rng: np.random.Generator) -> Solution:
    """Return the best of some samples."""
    noise = rng.standard_normal((config.num_samples, len(problem.mean)))
    samples = problem.clip(problem.mean + problem.std * noise)
    costs = problem.cost(samples)
    order = np.argsort(costs)[:config.num_elites]
    return Solution(samples[order[0]], float(costs[order[0]]), samples[order])


def reach(mpc, budget=60):
    """Push in a world of telekinesis; return the End and the steps."""
    loop, pixels, step = Reach(mpc, ReachConfig(budget, reached=2.0), seed=1), START, 0
    while True:
        seen = Observation(np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros(4, np.float32), ('a',),
                           pixels, step)
        answer = loop.step(seen)
        if isinstance(answer, SelectTargets):
            loop.set_targets([Target(GOAL)])
            answer = loop.step(seen)
        if isinstance(answer, End):
            return answer, loop.steps
        assert isinstance(answer, Command)
        pixels = pixels + np.float32([SCALE, -SCALE]) * answer.plan.action[:2]
        loop.sent()
        step += 1


@pytest.mark.parametrize('solver', [best_of_some, 'cem', 'icem'])
def test_a_goal_is_reached_with_any_forward_model_and_solver(solver):
    assert isinstance(Telekinesis(), tap_ros.ForwardModel)
    config = VisualMPCConfig(solver=solver, clearance=0.0, recheck=0, threads=1)
    end, steps = reach(VisualMPC(Telekinesis(), config))
    assert end.outcome == 'reached' and 5 <= steps < 60


def forgetful(problem: Problem, config: SearchConfig, rng: np.random.Generator) -> Solution:
    """Return the best of the last iteration."""
    best_of_some(problem, config, rng)
    return best_of_some(problem, config, rng)


@pytest.mark.parametrize('solver', [forgetful, 'cem', 'icem'])
def test_a_plan_ends_in_time_with_the_best_so_far_whatever_the_solver(solver):
    class Slow(Telekinesis):
        def carried_maps(self, *given):
            sizes.append(len(given[3]))
            time.sleep(0.05)
            return super().carried_maps(*given)

    scene = Scene(np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros(4, np.float32), START)
    mpc = VisualMPC(Slow(), VisualMPCConfig(solver=solver, batch_size=8, threads=1))
    found, plans = [], []
    for seconds in (inf, 1e6, 0.12, 0.0):  # the last: one part at least
        sizes = []
        plans.append(mpc.plan(scene, mpc.goal(GOAL), seconds=seconds))
        assert np.isfinite(plans[-1].cost) and len(plans[-1].elites)
        found.append(plans[-1].num_samples)
        assert seconds > 1 or sum(sizes[:-1]) == found[-1]
    assert found[0] == found[1] >= 64 > found[2] >= found[3] == sizes[0] > 0
    np.testing.assert_array_equal(plans[0].actions, plans[1].actions)
    assert plans[0].cost <= plans[3].cost


def test_a_cost_of_ones_own_is_minimised_with_the_same_model():
    class Away(PlanCost):
        def prices(self, distances):
            return -distances

    config = VisualMPCConfig(recheck=0, threads=1)
    end, _ = reach(VisualMPC(Telekinesis(), config, Away()), 10)
    assert end.outcome == 'spent'


class Loaded(Telekinesis):
    """Of the package of somebody else."""

    @classmethod
    def load(cls, argument, device='cpu'):
        assert argument == 'anything'
        return cls()


def test_a_planner_is_loaded_by_the_names_that_its_node_takes(monkeypatch):
    monkeypatch.setitem(plugins.BUILT_IN['tap_ros.forward_models'], 'loaded', f'{__name__}:Loaded')
    assert isinstance(VisualMPC.load('loaded:anything').model, Loaded)
    shipped = VisualMPC.load('push')
    assert shipped.model.config == VisualMPC.load('order3').model.config
    for name, error, said in (
            ('pussh', WeightsError, "did you mean 'push'.*valid: push, push2"),
            ('grasp', ConfigError, 'is a subgoal predictor'),
            ('nowhere/push', WeightsError, 'nowhere/push: no such weights file')):
        with pytest.raises(error, match=said):
            VisualMPC.load(name)


def test_solvers_of_other_packages_are_found_by_name(monkeypatch):
    point = EntryPoint('best_of_some', 'test_seams:best_of_some', 'tap_ros.solvers')
    monkeypatch.setattr(plugins, 'entry_points', lambda group, name=None: [
        point for name in [name or point.name] if (group, name) == (point.group, point.name)])
    mpc = VisualMPC(Telekinesis(), VisualMPCConfig(solver='best_of_some', threads=1))
    assert mpc.solver.__name__ == 'best_of_some'
    with pytest.raises(ConfigError, match="did you mean 'icem'"):
        VisualMPC(Telekinesis(), VisualMPCConfig(solver='icme', threads=1))
