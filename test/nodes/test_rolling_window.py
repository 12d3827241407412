# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of rates and percentiles over a window."""

import tracemalloc

import numpy as np
import pytest
from tap_ros.nodes.diagnostics import percentiles, rate, RollingWindow


@pytest.mark.parametrize('frequency', [0.5, 4.0, 30.0, 5000.0])
def test_the_rate_of_a_regular_stream_is_its_frequency(frequency):
    window = RollingWindow(10.0, 100)
    for index in range(500):
        window.add(index / frequency)
    assert rate(window.newest(500 / frequency)[0]) == pytest.approx(frequency, rel=1e-6)


def test_what_stopped_or_came_once_has_no_rate():
    window = RollingWindow(10.0, 100)
    assert rate(window.newest(0.0)[0]) == 0.0
    window.add(0.0)
    assert rate(window.newest(0.0)[0]) == 0.0
    window.add(0.0)
    assert rate(window.newest(0.0)[0]) == 0.0  # two at once tell no rate
    window.add(1.0)
    assert rate(window.newest(1.0)[0]) > 0
    assert rate(window.newest(11.1)[0]) == 0.0


def test_percentiles_are_those_of_the_last_minute_only():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.exponential(0.1, 2000))
    values = rng.exponential(5.0, 2000)
    window = RollingWindow(60.0, 10_000)
    for now, value in zip(times, values):
        window.add(now, value)
        if rng.random() < 0.01:  # asking in between changes nothing
            window.newest(now)
    now = times[-1] + 3.0
    late = values[now - times <= 60.0]
    assert 300 < len(late) < 900
    assert percentiles(window.newest(now)[1]).tolist() == np.percentile(late, (50, 99)).tolist()
    assert np.isnan(percentiles(window.newest(now + 60.0)[1])).all()


def test_a_number_counts_for_exactly_so_many_seconds():
    window = RollingWindow(2.0, 10)
    for now, value in enumerate((5.0, 6.0, 7.0)):
        window.add(now, value)
    assert [part.tolist() for part in window.newest(2.0)] == [[0, 1, 2], [5, 6, 7]]
    assert [part.tolist() for part in window.newest(2.5)] == [[1, 2], [6, 7]]
    window.add(3.0)
    assert window.newest(5.0)[1].tolist() == [0.0]


def test_memory_is_bounded_whatever_the_rate():
    window = RollingWindow(60.0, 1000)
    window.add(0.0, 0)
    tracemalloc.start()
    for index in range(1, 50_000):
        window.add(index * 1e-6, index)
    grown = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert grown < 100_000
    assert window.newest(0.05)[1].tolist() == list(range(49_000, 50_000))
