# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults: each test makes many trials and, with --report, leaves a row of a table."""

import sys

from fault_report import save, Trials
import pytest


@pytest.fixture
def trials(request):
    """Return the Trials of the test's fault."""
    report = request.config.getoption('--report')
    expected = [pattern for mark in request.node.iter_markers('errors') for pattern in mark.args]

    def wrong():
        processes = sys.modules.get('processes')  # else there is no node
        return processes.unexpected(processes.news(), expected) if processes else ''

    # Without a report other tests, and other programs, may run meanwhile.
    return Trials(request.node.get_closest_marker('fault').kwargs,
                  request.config.getoption('--share'), 1.0 if report else 8.0, wrong)


@pytest.fixture(scope='session')
def rig(tmp_path_factory):
    """Return the Rig that all faults of nodes share; it starts what each needs."""
    from fault_rig import Rig  # needs ROS, which faults of files do without
    with Rig(tmp_path_factory.mktemp('logs')) as rig:
        yield rig


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem):
    """Write the row of a fault, however its test ends, and fail it if a trial did not hold."""
    trials = pyfuncitem.funcargs.get('trials')
    error = None
    try:
        result = yield
        if trials is not None:
            if why := trials.wrong():  # said after the last trial
                trials.record(why)
            assert trials.held == trials.tried > 0, trials.why_not()
        return result
    except BaseException as raised:
        error = None if isinstance(raised, AssertionError) else raised
        raise
    finally:
        folder = pyfuncitem.config.getoption('--report')
        if folder and trials is not None and not isinstance(error, KeyboardInterrupt):
            name = pyfuncitem.name.removeprefix('test_').replace('_', '-').replace('[', '-')
            save(folder, trials.row(name.strip('-]'), error))
