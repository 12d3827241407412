# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes and clients of these tests talk among themselves only."""

import os

import pytest

os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


@pytest.fixture(scope='module')
def loop(tmp_path_factory):
    """All nodes as processes, for the tests of one file."""
    from loop import running_loop  # needs ROS, which the other tests here may do without
    with running_loop(tmp_path_factory.mktemp('loop')) as loop:
        yield loop
