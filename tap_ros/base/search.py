# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cross-entropy method, for any samples and any cost."""

from collections.abc import Callable
from typing import Any

import numpy as np

Draw = Callable[[np.ndarray | None], np.ndarray]
Cost = Callable[[np.ndarray], Any]


def cross_entropy(draw: Draw, cost: Cost, num_iterations: int,
                  num_elites: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Search the samples of least cost: draw some, judge them, draw others near the best, and so on.

    :param draw: function of the elites (E, ...) of the iteration before, the cheapest first, or
        None in the first iteration, to new samples (N, ...).
    :param cost: function of samples to costs (N,); NaN counts as worst, and minus infinity ends
        the search.
    :param num_elites: how many samples of an iteration the next one is drawn from, at most.
    :return: the best num_elites samples of all iterations, and their costs, the cheapest first,
        and the earliest of equals.
    """
    best, best_costs, elites = None, np.empty(0), None
    for _ in range(num_iterations):
        samples = draw(elites)
        costs = finite(cost(samples))
        elites = samples[np.argsort(costs, kind='stable')[:num_elites]]
        best = samples if best is None else np.concatenate([best, samples])
        best_costs = np.concatenate([best_costs, costs])
        first = np.argsort(best_costs, kind='stable')[:num_elites]
        best, best_costs = best[first], best_costs[first]
        if best_costs[0] == -np.inf:
            break
    assert best is not None, 'an iteration at least'
    return best, best_costs


def finite(costs: Any) -> np.ndarray:
    """Return costs as float64, the worst where they are not numbers."""
    return np.nan_to_num(np.asarray(costs, np.float64), nan=np.inf, posinf=np.inf, neginf=-np.inf)
