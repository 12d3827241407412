# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All tests of this folder need ROS; nodes and clients for them."""


from domains import reserve_domain
import pytest

# Apart from the domain of the other tests, whose nodes have the same names.
LOOP_DOMAIN = str(reserve_domain())


def pytest_itemcollected(item):
    """Mark the tests of this folder."""
    item.add_marker(pytest.mark.ros)


def pytest_collection_modifyitems(items):
    """Let the test that ends all nodes of the loop be the last."""
    items.sort(key=lambda item: 'every_node_ends_cleanly' in item.name)


@pytest.fixture
def client():
    """Return a node that is spun."""
    from processes import Client  # needs ROS, as loop does
    with Client() as node:
        yield node


def enter(patch):
    """Have what is started from now on in the domain of the loop, and predict as it does."""
    patch.setenv('ROS_DOMAIN_ID', LOOP_DOMAIN)
    # With more threads the predictor's last digits differ from process to process.
    patch.setenv('OMP_NUM_THREADS', '1')


@pytest.fixture(scope='session')
def running(tmp_path_factory):
    """All nodes as processes, started once."""
    from loop import running_loop
    with pytest.MonkeyPatch.context() as patch:
        enter(patch)
        context = running_loop(tmp_path_factory.mktemp('loop'))
        loop = context.__enter__()
    yield loop
    context.__exit__(None, None, None)


@pytest.fixture(scope='module')
def loop(running):
    """All nodes as processes, and the domain that they are in."""
    with pytest.MonkeyPatch.context() as patch:
        enter(patch)
        yield running
