# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cross-entropy method as a solver of the planner (App. F of the paper)."""

import numpy as np
from tap_ros.base.search import cross_entropy, finite
from tap_ros.planning.protocols import Problem, SearchConfig, Solution


def cem(problem: Problem, config: SearchConfig, rng: np.random.Generator) -> Solution:
    """
    Draw from a Gaussian with diagonal covariance, refit mean and deviation to the elites, repeat.

    With fewer elites than dimensions a full covariance has not full rank, which is why the
    diagonal is refitted.
    """
    def draw(elites: np.ndarray | None) -> np.ndarray:
        mean, std = (problem.mean, problem.std) if elites is None else (
            elites.mean(0), elites.std(0))
        samples = mean + std * rng.standard_normal((config.num_samples, len(mean)))
        return problem.clip(samples if elites is not None else proposed(problem, samples))

    best, costs = cross_entropy(draw, problem.cost, config.num_iterations, config.num_elites)
    return judged_once_more(problem, best, costs)


def proposed(problem: Problem, samples: np.ndarray) -> np.ndarray:
    """Put proposals in place of the last samples (N, D); if too many, the last of them count."""
    if problem.proposals is not None and len(problem.proposals):
        samples[-len(problem.proposals):] = problem.proposals[-len(samples):]
    return samples


def judged_once_more(problem: Problem, best: np.ndarray, costs: np.ndarray) -> Solution:
    """
    Take the best sample, by Problem.recheck if there is one.

    Of many noisy costs the least is an illusion.

    :param best: (E, D), the cheapest first; costs: (E,).
    """
    winner = 0 if problem.recheck is None else int(np.argmin(finite(problem.recheck(best))))
    return Solution(best[winner], float(costs[winner]), best)
