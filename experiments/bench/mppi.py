# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Model predictive path integral control, MPPI (Williams et al., ICRA 2017), beside the solvers.

Unlike cem.py, all samples count, each by its cost, the deviation stays, and the mean is judged.
"""

import numpy as np
from tap_ros.base.search import cross_entropy, finite
from tap_ros.planning.protocols import Problem, SearchConfig, Solution
from tap_ros.planning.solvers.cem import judged_once_more, proposed

TEMPERATURE = 0.1  # in distances from the least cost to the median


def mppi(problem: Problem, config: SearchConfig, rng: np.random.Generator) -> Solution:
    """Move the mean of a Gaussian to that of the samples, weighted by exp(-cost), and repeat."""
    mean = problem.mean

    def draw(elites: np.ndarray | None) -> np.ndarray:
        samples = mean + problem.std * rng.standard_normal((config.num_samples, len(mean)))
        if elites is None:
            return problem.clip(proposed(problem, samples))
        samples[-1] = mean
        return problem.clip(samples)

    def cost(samples: np.ndarray) -> np.ndarray:
        nonlocal mean
        costs = finite(problem.cost(samples))
        known = np.isfinite(costs)
        if known.any():
            above = costs[known] - costs[known].min()
            weights = np.exp(-above / (TEMPERATURE * np.median(above) or 1.0))
            mean = weights @ samples[known] / weights.sum()
        return costs

    best, costs = cross_entropy(draw, cost, config.num_iterations, config.num_elites)
    return judged_once_more(problem, best, costs)
