# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the cross-entropy method."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.errors import ConfigError
from tap_ros.planning.cem import cem, CEMConfig

TARGET = np.array([0.3, -0.7, 0.2])


def quadratic(samples):
    return ((samples - TARGET) ** 2).sum(1)


def search(config, seed=0, cost=quadratic, **options):
    rng = np.random.default_rng(seed)
    return cem(cost, np.zeros(3), np.ones(3), config, rng, **options)[:2]


def test_finds_the_optimum_of_a_quadratic():
    best, cost = search(CEMConfig(num_samples=200, num_iterations=12))
    np.testing.assert_allclose(best, TARGET, atol=0.01)
    assert cost == pytest.approx(quadratic(best[None])[0])


def test_more_iterations_never_find_worse():
    costs = [search(CEMConfig(num_iterations=n))[1] for n in (1, 2, 4, 8)]
    assert costs == sorted(costs, reverse=True)


def test_same_seed_same_result_and_another_seed_another():
    config = CEMConfig()
    np.testing.assert_array_equal(search(config)[0], search(config)[0])
    assert not np.array_equal(search(config)[0], search(config, seed=1)[0])


def test_best_proposal_wins_when_nothing_is_better():
    proposals = np.stack([TARGET + 1, TARGET])
    best, cost = search(CEMConfig(num_iterations=2), proposals=proposals)
    np.testing.assert_array_equal(best, TARGET)
    assert cost == 0


def test_proposals_are_the_last_samples_of_the_first_iteration_only():
    judged, proposals = [], np.stack([TARGET + 1, TARGET + 2])

    def cost(samples):
        judged.append(samples)
        return quadratic(samples)

    config = CEMConfig(num_samples=6, num_iterations=2, num_elites=3)
    search(config, cost=cost, proposals=proposals)
    search(config, cost=cost)
    np.testing.assert_array_equal(judged[0][-2:], proposals)
    np.testing.assert_array_equal(judged[0][:-2], judged[2][:-2])  # the others are drawn as ever
    assert not np.isin(proposals, judged[1]).any()
    search(replace(config, num_samples=3), cost=cost, proposals=np.arange(12.0).reshape(4, 3))
    np.testing.assert_array_equal(judged[4], np.arange(3.0, 12.0).reshape(3, 3))  # the last count


def test_only_repaired_samples_are_judged_and_returned():
    seen = []

    def cost(samples):
        seen.append(samples.copy())
        return quadratic(samples)

    best, _ = search(CEMConfig(), cost=cost, repair=lambda s: np.clip(s, -0.1, 0.1))
    assert np.abs(np.concatenate(seen)).max() <= 0.1
    np.testing.assert_allclose(best, [0.1, -0.1, 0.1])


def test_a_cost_that_is_not_a_number_never_wins():
    best, cost = search(
        CEMConfig(), cost=lambda s: np.where(s[:, 0] > 0, np.nan, quadratic(s)))
    assert best[0] <= 0 and np.isfinite(cost)


def test_the_elites_are_judged_once_more():
    judged = []

    def recheck(samples):
        judged.append(samples)
        costs = quadratic(samples)
        costs[0] = np.nan  # the best one was an illusion
        return costs

    best, cost = search(CEMConfig(num_elites=4), recheck=recheck)
    samples, = judged
    assert len(samples) == 4 and (np.diff(quadratic(samples)) >= 0).all()
    np.testing.assert_array_equal(best, samples[1])
    np.testing.assert_array_equal(samples[0], search(CEMConfig(num_elites=4))[0])
    assert cost == quadratic(best[None])[0]


def test_the_next_gaussian_has_mean_and_deviation_of_the_elites():
    judged, config = [], CEMConfig(num_samples=12, num_iterations=2, num_elites=3)
    search(config, cost=lambda samples: judged.append(samples) or quadratic(samples))
    elites = judged[0][np.argsort(quadratic(judged[0]))[:3]]
    noise = np.random.default_rng(0).standard_normal((2, 12, 3))[1]
    spread = np.sqrt(((elites - elites.mean(0)) ** 2).mean(0))
    np.testing.assert_allclose(judged[1], elites.mean(0) + spread * noise)


def test_the_first_of_equals_wins():
    judged = []
    best, _ = search(CEMConfig(), cost=lambda s: judged.append(s) or np.arange(len(s)) % 2)
    np.testing.assert_array_equal(best, judged[0][0])


def test_one_elite_and_all_samples_as_elites_are_possible():
    assert CEMConfig(5, 1, 1).num_elites == 1 and CEMConfig(5, 1, 5).num_elites == 5


@pytest.mark.parametrize('wrong, name', [
    ({'num_elites': 0}, 'num_elites'), ({'num_elites': 300}, 'num_elites'),
    ({'num_iterations': 0}, 'num_iterations')])
def test_impossible_settings_are_named(wrong, name):
    with pytest.raises(ConfigError, match=name):
        CEMConfig(**wrong)
