# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of all solvers, and of each."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.base.plugins import BUILT_IN, load_plugin
from tap_ros.base.search import cross_entropy
from tap_ros.planning.protocols import Problem, SearchConfig
from tap_ros.planning.solvers.icem import icem

TARGET = np.array([0.3, -0.7, 0.2])
solvers = pytest.mark.parametrize('solver', [
    load_plugin('tap_ros.solvers', name) for name in BUILT_IN['tap_ros.solvers']])


def quadratic(samples):
    return ((samples - TARGET) ** 2).sum(1)


def problem(**changes):
    return replace(Problem(quadratic, np.zeros(3), np.ones(3)), **changes)


def search(config, solver, **changes):
    return solver(problem(**changes), config, np.random.default_rng(0))


@solvers
def test_finds_the_optimum_of_a_quadratic_and_repeats_from_its_seed(solver):
    config = SearchConfig(num_samples=200, num_iterations=12)
    found, again = (search(config, solver=solver) for _ in range(2))
    np.testing.assert_allclose(found.best, TARGET, atol=0.02)
    assert found.cost == pytest.approx(quadratic(found.best[None])[0])
    assert len(found.elites) == 10 and (np.diff(quadratic(found.elites)) >= 0).all()
    np.testing.assert_array_equal(found.best, again.best)
    for iterations in (1, 3):  # a proposal wins when nothing is better
        found = search(SearchConfig(num_iterations=iterations), solver=solver,
                       proposals=np.stack([TARGET + 1, TARGET]))
        np.testing.assert_array_equal(found.best, TARGET)


@solvers
def test_only_clipped_samples_are_judged_and_what_is_not_a_number_never_wins(solver):
    seen = []
    found = search(SearchConfig(), solver=solver, clip=lambda s: np.clip(s, -0.1, 0.1),
                   cost=lambda s: seen.append(s.copy()) or quadratic(s))
    assert np.abs(np.concatenate(seen)).max() <= 0.1
    np.testing.assert_allclose(found.best, [0.1, -0.1, 0.1])
    found = search(SearchConfig(), solver=solver,
                   cost=lambda s: np.where(s[:, 0] > 0, np.nan, quadratic(s)))
    assert found.best[0] <= 0 and np.isfinite(found.cost)


@solvers
def test_the_elites_are_judged_once_more(solver):
    judged = []

    def recheck(samples):
        judged.append(samples)
        costs = quadratic(samples)
        costs[0] = np.nan  # the best one was an illusion
        return costs

    config = SearchConfig(num_elites=4)
    found = search(config, solver=solver, recheck=recheck)
    samples, = judged
    assert len(samples) == 4 and (np.diff(quadratic(samples)) >= 0).all()
    np.testing.assert_array_equal(found.best, samples[1])
    np.testing.assert_array_equal(samples[0], search(config, solver=solver).best)
    assert found.cost == quadratic(found.best[None])[0]


def test_icem_moves_on_in_one_direction():
    moves, judged = 6, []
    search(SearchConfig(4000, 1, 10), icem, moves=moves, mean=np.zeros(2 * moves + 1),
           std=np.ones(2 * moves + 1), cost=lambda s: judged.append(s) or s[:, 0])
    steps = judged[0][:4000, :12].reshape(-1, moves, 2)
    np.testing.assert_allclose(steps.var(0), 1, atol=0.1)
    assert (steps[:, 1:] * steps[:, :-1]).mean() > 0.4  # a displacement tells of the next one
    assert abs(np.prod(steps, axis=2).mean()) < 0.1  # but x nothing of y


def test_a_cost_of_minus_infinity_ends_the_search_with_its_sample():
    asked = []
    best, costs = cross_entropy(
        lambda elites: np.arange(5.0), lambda samples: asked.append(1) or np.array(
            [4, np.nan, -np.inf if len(asked) == 2 else 2, 3, 0]), num_iterations=9, num_elites=3)
    assert len(asked) == 2 and best.tolist() == [2, 4, 4] and costs.tolist() == [-np.inf, 0, 0]
