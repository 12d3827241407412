# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of real nodes, each a few times; `make faults` tries them often."""

import os

from experiments.faults.runner import run_faults
import pytest

pytestmark = [pytest.mark.ros, pytest.mark.slow]

FEW = {  # trials of each; in this order few nodes have to be started anew
    'camera-silent': 1, 'objects-silent': 1, 'joints-silent': 1, 'camera-dead': 1,
    'scene-clock': 1, 'scene-objects': 2, 'pixels-planner': 2, 'predictor-killed': 1,
    'pixels-predictor': 3, 'clients-16': 32, 'large-requests': 2, 'goals-after-cancel': 3,
    'goals-after-reset': 3, 'generated-messages': 500}


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    from experiments.faults.nodes.rig import Rig  # needs ROS, which other tests here do without
    before = dict(os.environ)
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    try:
        with Rig(tmp_path_factory.mktemp('logs')) as rig:
            yield rig
    finally:
        os.environ.clear()
        os.environ.update(before)


@pytest.mark.parametrize('name', FEW)
def test_a_fault_is_borne(name, rig, tmp_path):
    from experiments.faults.nodes.all_faults import GROUPS
    count = {fault.name: fault.count for faults in GROUPS.values() for fault in faults}[name]
    row, = run_faults(GROUPS, tmp_path, [name], FEW[name] / count, rig=rig, progress=False,
                      patience=8.0)  # other tests, and other programs, run meanwhile
    assert row['held'] == row['tried'] > 0, row['why_not']


def test_a_crash_is_not_taken_for_an_interpreter_that_was_interrupted(tmp_path, monkeypatch):
    from experiments.faults.nodes import start_stop

    class Crashes(start_stop.Attacked):
        """Dies of another signal than it was sent."""

        def end(self, number, patience):
            self.process.kill()
            return self.process.wait()

    monkeypatch.setattr(start_stop, 'Attacked', Crashes)
    why, _ = start_stop._one(tmp_path, 'sim_node', 1, 0.0, 0.0)
    assert 'SIGKILL' in why
