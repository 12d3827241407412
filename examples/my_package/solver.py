# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from tap_ros import Problem, SearchConfig, Solution


def random_search(problem: Problem, config: SearchConfig, rng) -> Solution:
    """Return the best of random samples."""
    noise = rng.standard_normal((config.num_samples, len(problem.mean)))
    samples = problem.clip(problem.mean + problem.std * noise)
    costs = problem.cost(samples)
    order = costs.argsort()[:config.num_elites]
    return Solution(samples[order[0]], float(costs[order[0]]), samples[order])
