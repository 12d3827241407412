# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of all solvers, and of each."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.planning.protocols import Problem, SearchConfig
from tap_ros.planning.solvers.cem import cem
from tap_ros.planning.solvers.icem import coloured_root, icem
from tap_ros.plugins import load_plugin, names

TARGET = np.array([0.3, -0.7, 0.2])
solvers = pytest.mark.parametrize('solver', [
    load_plugin('tap_ros.solvers', name) for name in names('tap_ros.solvers')])


def quadratic(samples):
    return ((samples - TARGET) ** 2).sum(1)


def problem(**changes):
    return replace(Problem(quadratic, np.zeros(3), np.ones(3)), **changes)


def search(config, seed=0, solver=cem, **changes):
    return solver(problem(**changes), config, np.random.default_rng(seed))


@solvers
def test_finds_the_optimum_of_a_quadratic_and_tells_its_cost(solver):
    found = search(SearchConfig(num_samples=200, num_iterations=12), solver=solver)
    np.testing.assert_allclose(found.best, TARGET, atol=0.02)
    assert found.cost == pytest.approx(quadratic(found.best[None])[0])
    assert len(found.elites) == 10 and (np.diff(quadratic(found.elites)) >= 0).all()


@solvers
def test_same_seed_same_result_and_another_seed_another(solver):
    config = SearchConfig()
    first, again, other = (search(config, seed, solver).best for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@solvers
def test_the_best_proposal_wins_when_nothing_is_better(solver):
    found = search(SearchConfig(), solver=solver, proposals=np.stack([TARGET + 1, TARGET]))
    np.testing.assert_array_equal(found.best, TARGET)
    assert found.cost == 0


@solvers
def test_only_clipped_samples_are_judged_and_returned(solver):
    seen = []
    found = search(SearchConfig(), solver=solver, clip=lambda s: np.clip(s, -0.1, 0.1),
                   cost=lambda s: seen.append(s.copy()) or quadratic(s))
    assert np.abs(np.concatenate(seen)).max() <= 0.1
    np.testing.assert_allclose(found.best, [0.1, -0.1, 0.1])


@solvers
def test_a_cost_that_is_not_a_number_never_wins(solver):
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


def test_proposals_are_the_last_samples_of_the_first_iteration_only():
    judged, proposals = [], np.stack([TARGET + 1, TARGET + 2])

    def cost(samples):
        judged.append(samples)
        return quadratic(samples)

    config = SearchConfig(num_samples=6, num_iterations=2, num_elites=3)
    search(config, cost=cost, proposals=proposals)
    search(config, cost=cost)
    np.testing.assert_array_equal(judged[0][-2:], proposals)
    np.testing.assert_array_equal(judged[0][:-2], judged[2][:-2])  # the others are drawn as ever
    assert not np.isin(proposals, judged[1]).any()
    search(replace(config, num_samples=3), cost=cost, proposals=np.arange(12.0).reshape(4, 3))
    np.testing.assert_array_equal(judged[4], np.arange(3.0, 12.0).reshape(3, 3))  # the last count


def test_the_next_gaussian_has_mean_and_deviation_of_the_elites():
    judged, config = [], SearchConfig(num_samples=12, num_iterations=2, num_elites=3)
    search(config, cost=lambda samples: judged.append(samples) or quadratic(samples))
    elites = judged[0][np.argsort(quadratic(judged[0]))[:3]]
    noise = np.random.default_rng(0).standard_normal((2, 12, 3))[1]
    spread = np.sqrt(((elites - elites.mean(0)) ** 2).mean(0))
    np.testing.assert_allclose(judged[1], elites.mean(0) + spread * noise)


def test_icem_keeps_what_was_good_draws_fewer_and_judges_the_mean_at_last():
    judged, kept = [], np.tile(TARGET, (10, 1))
    found = search(SearchConfig(100, 3, 10), solver=icem, kept=kept,
                   cost=lambda s: judged.append(s) or quadratic(s))
    assert found.cost == 0 and [len(samples) for samples in judged] == [103, 83, 64 + 3 + 1]
    np.testing.assert_array_equal(judged[0][100:], kept[:3])
    for before, after in zip(judged, judged[1:]):
        best = before[np.argsort(quadratic(before), kind='stable')[:3]]
        assert all((after == one).all(1).any() for one in best)


def test_icem_moves_on_in_one_direction():
    moves, judged = 6, []
    search(SearchConfig(4000, 1, 10), solver=icem, moves=moves, mean=np.zeros(2 * moves + 1),
           std=np.ones(2 * moves + 1), cost=lambda s: judged.append(s) or s[:, 0])
    steps = judged[0][:4000, :12].reshape(-1, moves, 2)
    np.testing.assert_allclose(steps.var(0), 1, atol=0.1)
    assert (steps[:, 1:] * steps[:, :-1]).mean() > 0.4  # a displacement tells of the next one
    assert abs(np.prod(steps, axis=2).mean()) < 0.1  # but x nothing of y
    np.testing.assert_allclose(coloured_root(moves, 0.0), np.eye(moves), atol=1e-12)
