# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What came of late, in bounded memory."""

from collections import deque

import numpy as np


class Window:
    """
    Numbers, each with the moment at which it came; the old ones are forgotten.

    :param seconds: how long a number counts.
    :param limit: most numbers kept, the newest ones; bounds the memory whatever their rate.
    """

    def __init__(self, seconds, limit):
        self._seconds = seconds
        self._items = deque(maxlen=limit)

    def add(self, now, value=0.0):
        """Add a number that came at `now`, in seconds of a clock that never goes back."""
        self._items.append((now, value))

    def newest(self, now):
        """Return times and values, each float64 (N,), oldest first."""
        while self._items and now - self._items[0][0] > self._seconds:
            self._items.popleft()
        return np.array(self._items, np.float64).reshape(-1, 2).T


def rate(times):
    """
    Return how many came per second; 0 for fewer than two.

    :param times: (N,) seconds, oldest first.
    """
    span = times[-1] - times[0] if len(times) else 0.0
    return (len(times) - 1) / span if span > 0 else 0.0


def percentiles(values):
    """Return the 50th and the 99th percentile; NaN without values."""
    return np.percentile(values, (50, 99)) if len(values) else np.full(2, np.nan)
