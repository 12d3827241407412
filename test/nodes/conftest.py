# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All tests of this folder need ROS; nodes and clients for them."""

import os

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


# A solver of another package that searches a little: most time of these tests is planning.
QUICK = """
from dataclasses import replace
from tap_ros.planning.solvers.cem import cem

def solve(problem, config, rng):
    few = replace(config, num_samples=24, num_iterations=1, num_elites=3)
    return cem(problem, few, rng)
"""


def enter(patch, folder):
    """Have what is started from now on in the domain of the loop, and predict as it does."""
    patch.setenv('ROS_DOMAIN_ID', LOOP_DOMAIN)
    # With more threads the predictor's last digits differ from process to process.
    patch.setenv('OMP_NUM_THREADS', '1')
    patch.setenv('PYTHONPATH', str(folder), prepend=os.pathsep)
    patch.syspath_prepend(folder)


@pytest.fixture(scope='session')
def running(tmp_path_factory):
    """All nodes as processes, started once; and the folder of the solver's package."""
    from loop import running_loop
    folder = tmp_path_factory.mktemp('solver')
    (folder / 'quick.py').write_text(QUICK)
    (folder / 'quick-1.dist-info').mkdir()
    (folder / 'quick-1.dist-info' / 'entry_points.txt').write_text(
        '[tap_ros.solvers]\nquick = quick:solve\n')
    with pytest.MonkeyPatch.context() as patch:
        enter(patch, folder)
        context = running_loop(tmp_path_factory.mktemp('loop'))
        loop = context.__enter__()
    yield loop, folder
    context.__exit__(None, None, None)


@pytest.fixture(scope='module')
def loop(running):
    """All nodes as processes, and the domain that they are in."""
    loop, folder = running
    with pytest.MonkeyPatch.context() as patch:
        enter(patch, folder)
        yield loop
