# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cross-entropy method, for any cost."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.search import cross_entropy, finite


@dataclass(frozen=True)
class CEMConfig:
    """
    Settings of the search.

    :param num_samples: per iteration; num_iterations; num_elites: that the next Gaussian fits.
    """

    num_samples: int = 200
    num_iterations: int = 3
    num_elites: int = 10

    def __post_init__(self) -> None:
        if not 1 <= self.num_elites <= self.num_samples:
            raise ConfigError(f'num_elites: expected 1..{self.num_samples} (num_samples), '
                              f'got {self.num_elites}')
        if self.num_iterations < 1:
            raise ConfigError(f'num_iterations: expected at least 1, got {self.num_iterations}')


def cem(cost: Callable[[np.ndarray], np.ndarray], mean: np.ndarray, std: np.ndarray,
        config: CEMConfig, rng: np.random.Generator,
        repair: Callable[[np.ndarray], np.ndarray] | None = None,
        proposals: np.ndarray | None = None,
        recheck: Callable[[np.ndarray], np.ndarray] | None = None
        ) -> tuple[np.ndarray, float, np.ndarray]:
    """
    Search the minimum of a cost (cross-entropy method, App. F of the paper).

    Repeat: draw samples from a Gaussian with diagonal covariance, judge them, refit mean and
    standard deviation to the elites. The best sample ever judged wins. With fewer elites than
    dimensions a full covariance has not full rank, which is why the diagonal is refitted.

    :param cost: function of samples (N, D) to costs (N,); NaN counts as worst.
    :param mean: (D,) of the first Gaussian; std: (D,).
    :param config: CEMConfig.
    :param rng: numpy Generator; all randomness comes from it, in an order that depends on the
        configuration only.
    :param repair: function that clips samples (N, D) to what is allowed, or None.
    :param proposals: (P, D) that replace the first iteration's last samples, or None; P at most
        num_samples, else the last count.
    :param recheck: cost that the best num_elites of all iterations are judged by once more, with
        the same convention; of many noisy costs the least is an illusion.
    :return: best sample (D,); its cost, not the one by recheck; the best num_elites of all
        iterations (E, D), the cheapest first.
    """
    def draw(elites: np.ndarray | None) -> np.ndarray:
        middle, spread = (mean, std) if elites is None else (elites.mean(0), elites.std(0))
        noise = rng.standard_normal((config.num_samples, len(middle)))
        samples = middle + spread * noise
        if elites is None and proposals is not None and len(proposals):
            samples[-len(proposals):] = proposals[-config.num_samples:]
        return samples if repair is None else repair(samples)

    best, costs = cross_entropy(draw, cost, config.num_iterations, config.num_elites)
    winner = 0 if recheck is None else int(np.argmin(finite(recheck(best))))
    return best[winner], float(costs[winner]), best
