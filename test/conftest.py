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


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Keep decoded recordings out of the user's cache."""
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path_factory.getbasetemp() / 'cache'))
