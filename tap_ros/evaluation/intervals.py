# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far a mean over episodes can be trusted: percentile bootstrap intervals of 95%."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

RESAMPLES = 2000
_DRAWN = 2 ** 22  # numbers drawn at once, to bound memory


class Interval(NamedTuple):
    """
    A value and where it lies with 95% confidence.

    :param value: of all episodes.
    :param low: lower end.
    :param high: upper end.
    """

    value: float
    low: float
    high: float


def bootstrap(statistic: Callable[..., Any], *arrays: ArrayLike, resamples: int = RESAMPLES,
              seed: int = 0) -> Interval:
    """
    Estimate a statistic of episodes: N of the N episodes are drawn again and again.

    The same episodes are drawn from all arrays, so that differences are paired.

    :param statistic: function of arrays (..., N) that gives (...); NaN where it is undefined.
    :param arrays: of the same N along the last axis, at least 1.
    :param resamples: how often to draw.
    :param seed: of the draws.
    :return: Interval; both ends are NaN if the statistic is undefined in every draw.
    """
    arrays = [np.asarray(array) for array in arrays]
    N = arrays[0].shape[-1]
    value = float(statistic(*arrays))
    rng = np.random.default_rng(seed)
    at_once = max(1, _DRAWN // max(array.size for array in arrays))
    values = []
    for first in range(0, resamples, at_once):
        drawn = rng.integers(N, size=(min(at_once, resamples - first), N))
        values.append(statistic(*(array[..., drawn] for array in arrays)))
    values = np.concatenate(values)
    if np.isnan(values).all():
        return Interval(value, np.nan, np.nan)
    low, high = np.nanpercentile(values, (2.5, 97.5))
    return Interval(value, float(low), float(high))


def mean_interval(values: ArrayLike, **options: int) -> Interval:
    """
    Estimate the mean over episodes.

    :param values: (N,).
    :param options: of bootstrap.
    :return: Interval.
    """
    return bootstrap(lambda values: values.mean(-1), np.asarray(values, float), **options)


def gain_interval(errors: ArrayLike, baseline: ArrayLike, **options: int) -> Interval:
    """
    Estimate by which share a method's mean error is below a baseline's on the same episodes.

    :param errors: (N,), of the method.
    :param baseline: (N,), of the baseline, in the same order.
    :param options: of bootstrap.
    :return: Interval; 0.25 is an error a quarter lower.
    """
    return bootstrap(lambda errors, baseline: 1 - errors.mean(-1) / baseline.mean(-1),
                     np.asarray(errors, float), np.asarray(baseline, float), **options)
