# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All tests of this folder need ROS; nodes and clients for them."""

import pytest


def pytest_itemcollected(item):
    """Mark the tests of this folder."""
    item.add_marker(pytest.mark.ros)


@pytest.fixture
def client():
    """Return a node that is spun."""
    from processes import Client  # needs ROS, as loop does
    with Client() as node:
        yield node


@pytest.fixture(scope='module')
def loop(tmp_path_factory):
    """All nodes as processes, for the tests of one file."""
    from loop import running_loop
    with running_loop(tmp_path_factory.mktemp('loop')) as loop:
        yield loop
