# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The improved cross-entropy method, iCEM (Pinneri et al., CoRL 2020, arXiv:2008.06389).

Beside cem.py: noise is coloured over time, so that displacements go on in one direction; later
iterations draw fewer samples; a share of the elites stays in the next iteration and, carried on
by one step, in the next plan; mean and deviation move with momentum; the last iteration also
judges the mean.
"""

import numpy as np
from tap_ros.base.search import cross_entropy
from tap_ros.planning.protocols import Problem, SearchConfig, Solution
from tap_ros.planning.solvers.cem import judged_once_more

BETA = 2.0  # exponent of the noise's power spectrum, 1 / f^BETA; 0 is white
KEPT = 0.3  # share of the elites that stay
DECAY = 1.25  # each iteration draws so many times fewer samples
MOMENTUM = 0.1  # of mean and deviation


def icem(problem: Problem, config: SearchConfig, rng: np.random.Generator) -> Solution:
    """Search by iCEM; num_samples is that of the first iteration."""
    mean, std, iteration = problem.mean, problem.std, 0
    root = coloured_root(problem.moves)

    def draw(elites: np.ndarray | None) -> np.ndarray:
        nonlocal mean, std, iteration
        kept = problem.kept if elites is None else elites
        if elites is not None:
            # refit
            mean = MOMENTUM * mean + (1 - MOMENTUM) * elites.mean(0)
            std = MOMENTUM * std + (1 - MOMENTUM) * elites.std(0)
        # draw, ever fewer
        count = max(2 * config.num_elites, round(config.num_samples * DECAY ** -iteration))
        noise = rng.standard_normal((count, len(mean)))
        moves = noise[:, :2 * problem.moves].reshape(count, problem.moves, 2)
        noise[:, :2 * problem.moves] = (root @ moves).reshape(count, -1)
        samples = [mean + std * noise]
        # add what was good before
        if kept is not None:
            samples.append(kept[:int(np.ceil(KEPT * len(kept)))])
        if elites is None and problem.proposals is not None:
            samples.append(problem.proposals)
        iteration += 1
        if iteration == config.num_iterations:
            samples.append(mean[None])
        return problem.clip(np.concatenate(samples))

    best, costs = cross_entropy(draw, problem.cost, config.num_iterations, config.num_elites)
    return judged_once_more(problem, best, costs)


def coloured_root(count: int) -> np.ndarray:
    """
    Return what colours white noise over time.

    :param count: T.
    :return: (T, T); times white noise (T, ...) it has the spectrum 1 / f^BETA and variance 1.
    """
    if not count:
        return np.zeros((0, 0))
    power = np.maximum(np.abs(np.fft.fftfreq(count)), 1 / count) ** -BETA
    correlation = np.fft.ifft(power).real
    lags = np.subtract.outer(np.arange(count), np.arange(count)) % count
    root: np.ndarray = np.linalg.cholesky(correlation[lags] / correlation[0])
    return root
