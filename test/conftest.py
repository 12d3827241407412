# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What all tests share.

Modules beside this file (browsing, domains, made_episodes, processes) can be imported by every
test.
"""

import os
import signal
import sys

from domains import reserve_domain
from hypothesis import HealthCheck, settings
import pytest

# Nodes and clients of these tests talk among themselves only, whatever domain is set: two workers
# in one would hear each other, and so would two runs on one machine.
os.environ['ROS_DOMAIN_ID'] = str(reserve_domain())
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
if 'PYTEST_XDIST_WORKER' in os.environ:  # workers share the cores
    os.environ.setdefault('OMP_NUM_THREADS', '1')
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a script
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests and what they start need it
# How fast examples come says nothing, as other tests run beside these.
settings.register_profile(
    'tap_ros', deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile('tap_ros')


def pytest_addoption(parser):
    """Let `pytest -m fault` be told how often each fault is tried, and where to report it."""
    parser.addoption('--share', type=float, default=0.02, help='share of the trials of each fault')
    parser.addoption('--report', default='', help='folder of faults.json and faults.md')


def pytest_collection_modifyitems(config, items):
    """Leave out the faults, unless they are asked for."""
    if 'fault' not in config.option.markexpr:
        faults = [item for item in items if item.get_closest_marker('fault')]
        items[:] = [item for item in items if not item.get_closest_marker('fault')]
        config.hook.pytest_deselected(items=faults)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """
    Fail a test in which a node logged a traceback or an error that no `errors` mark names.

    One that failed shows the logs.
    """
    report = yield
    processes = sys.modules.get('processes')  # else there is no node
    if call.when == 'call' and report.failed and processes is not None:
        report.sections.append(('logs of the nodes, their ends', processes.ends()))
    if call.when == 'teardown' and processes is not None:
        wrong = processes.unexpected(report.capstderr + processes.news(), [
            pattern for other in item.session.items if other.path == item.path
            for mark in other.iter_markers('errors') for pattern in mark.args])
        if wrong and report.passed:
            report.outcome, report.longrepr = 'failed', wrong
    return report


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_xdist_make_scheduler(config, log):
    """Give the tests of a file to one worker, and all tests of real nodes to one."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):

        def _split_scope(self, nodeid):
            file = nodeid.split('::', 1)[0]
            return 'nodes' if 'nodes' in file else file

    return Scheduling(config, log)


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Keep decoded recordings out of the user's cache."""
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path_factory.getbasetemp() / 'cache'))
