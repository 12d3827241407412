# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How far a mean over episodes can be trusted: intervals of 95%, by bootstrap or of Wilson."""

from collections.abc import Callable
from typing import Any, NamedTuple
import warnings

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.training.split import FEW

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


def bootstrap(statistic: Callable[..., Any], *arrays: ArrayLike,
              resamples: int = RESAMPLES) -> Interval:
    """
    Estimate a statistic of episodes: N of the N episodes are drawn again and again.

    The same episodes are drawn from all arrays, so that differences are paired.

    :param statistic: function of arrays (..., N) that gives (...); NaN where it is undefined.
    :param arrays: of the same N along the last axis, at least 1.
    :param resamples: how often to draw.
    :return: Interval over the draws in which the statistic is defined; NaN to NaN without any.
    """
    from scipy import stats  # takes a second

    arrays = [np.asarray(array) for array in arrays]
    N = arrays[0].shape[-1]
    value = float(statistic(*arrays))
    if N == 1:
        return Interval(value, value, value)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', stats.DegenerateDataWarning)  # of undefined draws
        draws = stats.bootstrap(
            (np.arange(N),), lambda drawn, axis: statistic(*(a[..., drawn] for a in arrays)),
            n_resamples=resamples, batch=max(1, _DRAWN // max(a.size for a in arrays)),
            vectorized=True, method='percentile', random_state=np.random.default_rng(0),
        ).bootstrap_distribution
    if np.isnan(draws).all():
        return Interval(value, np.nan, np.nan)
    low, high = np.nanpercentile(draws, (2.5, 97.5))
    return Interval(value, float(low), float(high))


def mean_interval(values: ArrayLike) -> Interval:
    """Estimate the mean over episodes of values (N,)."""
    return bootstrap(lambda values: values.mean(-1), np.asarray(values, float))


def share_interval(successes: ArrayLike) -> Interval:
    """
    Estimate in which share of episodes something holds, by Wilson's interval.

    Where it holds in all or in none, a bootstrap would say that this is certain.

    :param successes: (N,) of 0 and 1, at least one.
    :return: Interval, 0 to 1.
    """
    from scipy import stats

    values = np.asarray(successes, float)
    found = stats.binomtest(round(values.sum()), len(values)).proportion_ci(method='wilson')
    return Interval(float(values.mean()), float(found.low), float(found.high))


def against_copying(errors: np.ndarray, copied: np.ndarray) -> tuple[str, Interval]:
    """
    Compare errors of episodes (N,) with those of copying an input instead (N,).

    :return: in words which is better, where that can be told; and the ratio of their means.
    """
    ratio = bootstrap(lambda ours, theirs: ours.mean(-1) / theirs.mean(-1), errors, copied)
    if len(errors) < FEW:
        return 'too few to tell from copying', ratio
    return ('better than copying' if ratio.high < 1 else 'worse than copying' if ratio.low > 1
            else 'not told from copying'), ratio
