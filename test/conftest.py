# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What all tests share.

Modules beside this file (made_episodes, lively) can be imported by every test.
"""

import os

import pytest

# Nodes and clients of these tests talk among themselves only.
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
if 'PYTEST_XDIST_WORKER' in os.environ:  # workers share the cores
    os.environ.setdefault('OMP_NUM_THREADS', '1')


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Give all tests of real nodes to one of several workers, and those of a file to one."""
    if config.pluginmanager.hasplugin('xdist'):
        for item in items:
            alone = item.get_closest_marker('ros')
            item.add_marker(pytest.mark.xdist_group('ros' if alone else str(item.path)))


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Keep decoded recordings out of the user's cache."""
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path_factory.getbasetemp() / 'cache'))
