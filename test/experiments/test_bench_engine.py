# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the engines: what it measures, and what its page says."""

from experiments.bench import engine
import pytest


def test_an_engine_is_measured(monkeypatch):
    for name, value in (('FEW', 2), ('MANY', 12), ('SLEEPS', 4)):
        monkeypatch.setattr(engine, name, value)
    row = engine.measure('local', 2)
    assert (row['engine'], row['workers']) == ('local', 2)
    assert row['start_s'] > 0 and row['sleeping'] > 0.5


@pytest.mark.parametrize('task_ms, share', [(0.5, '86%'), (50.0, '')])
def test_the_page_says_what_the_figures_mean(task_ms, share):
    page = engine.make_page([{'engine': 'ray', 'workers': 16, 'task_ms': task_ms, 'start_s': 1.75,
                              'sleeping': 1.02}])
    assert f'| ray | 16 | {task_ms:.2f} ms | 1.8 s | 1.02 |' in page
    work, hand = 2 * 25 * 0.23, 400 * task_ms / 1000
    assert f'{work / (work + 1.75 + hand):.0%} of the time is work' in page
    assert share in page
