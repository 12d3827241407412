# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A solver, a forward model and a cost of one's own drive the planner and the control loop."""

from importlib.metadata import EntryPoint

import numpy as np
import pytest
import tap_ros
from tap_ros import plugins, VisualMPC
from tap_ros.errors import ConfigError
from tap_ros.planning.cost import PlanCost
from tap_ros.planning.hierarchy import Target
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import Problem, SearchConfig, Solution
from tap_ros.planning.reach import Aim, Command, End, Reach, ReachConfig, Seen
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
        seen = Seen(np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros(4, np.float32), ('a',), pixels,
                    step)
        answer = loop.step(seen)
        if isinstance(answer, Aim):
            loop.head_for([Target(GOAL)])
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


def test_a_cost_of_ones_own_is_minimised_with_the_same_model():
    class Away(PlanCost):
        def prices(self, distances):
            return -distances

    config = VisualMPCConfig(recheck=0, threads=1)
    end, _ = reach(VisualMPC(Telekinesis(), config, Away()), 10)
    assert end.outcome == 'spent'


def test_solvers_of_other_packages_are_found_by_name(monkeypatch):
    point = EntryPoint('best_of_some', 'test_seams:best_of_some', 'tap_ros.solvers')
    monkeypatch.setattr(plugins, 'entry_points', lambda group, name=None: [
        point for name in [name or point.name] if (group, name) == (point.group, point.name)])
    mpc = VisualMPC(Telekinesis(), VisualMPCConfig(solver='best_of_some', threads=1))
    assert mpc.solver.__name__ == 'best_of_some'
    with pytest.raises(ConfigError, match="did you mean 'icem'"):
        VisualMPC(Telekinesis(), VisualMPCConfig(solver='icme', threads=1))
