# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags to read."""

from made_episodes import cover, make_episode, write_bag
import pytest


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Return a cache that each test has for itself."""
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path / 'cache'))
    return tmp_path / 'cache'


@pytest.fixture
def episodes():
    """Make episodes of several lengths, with robot masks; their stamps go on."""
    return [cover(make_episode(seed, T=3 + seed % 4, start=(seed + 1) * 10**10))
            for seed in range(7)]


@pytest.fixture
def bag(tmp_path, episodes):
    """Write the episodes into a bag of two files."""
    return write_bag(tmp_path / 'push2', episodes[:4], episodes[4:])
