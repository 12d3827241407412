# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What came of late, in bounded memory."""

import numpy as np


class Window:
    """
    Numbers, each with the moment at which it came; the old ones are forgotten.

    :param seconds: how long a number counts.
    :param limit: most numbers kept, the newest ones; bounds the memory whatever their rate.
    """

    def __init__(self, seconds: float, limit: int) -> None:
        self._seconds = seconds
        self._times, self._values = np.empty(limit), np.empty(limit)  # rings: fast to summarise
        self._count = 0

    def add(self, now: float, value: float = 0.0) -> None:
        """Add a number that came at `now`, in seconds of a clock that never goes back."""
        place = self._count % len(self._times)
        self._times[place], self._values[place] = now, value
        self._count += 1

    def newest(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Return times and values, each float64 (N,), oldest first."""
        limit = len(self._times)
        places = np.arange(max(self._count - limit, 0), self._count) % limit
        places = places[np.searchsorted(self._times[places], now - self._seconds):]
        return self._times[places], self._values[places]


def rate(times: np.ndarray) -> float:
    """
    Return how many came per second; 0 for fewer than two.

    :param times: (N,) seconds, oldest first.
    """
    span = times[-1] - times[0] if len(times) else 0.0
    return (len(times) - 1) / span if span > 0 else 0.0


def percentiles(values: np.ndarray) -> np.ndarray:
    """Return the 50th and the 99th percentile; NaN without values."""
    return np.percentile(values, (50, 99)) if len(values) else np.full(2, np.nan)
