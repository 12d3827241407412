# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the processes of nodes that a command starts."""

import os
import signal
import subprocess
import sys

import pytest

COMMAND = """
import sys, time
from tap_ros.nodes.node_processes import NodeProcesses
with NodeProcesses(sys.argv[1]) as processes:
    processes.start('robot_mask_node')
    print(processes._processes['robot_mask_node'].pid, flush=True)
    time.sleep(60)
"""


def lives(pid):
    """Return whether there is such a process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP])
def test_no_node_outlives_the_command_that_started_it(number, tmp_path):
    command = subprocess.Popen([sys.executable, '-c', COMMAND, str(tmp_path)],
                               stdout=subprocess.PIPE, text=True,
                               preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL))
    node = int(command.stdout.readline())
    assert lives(node)
    command.send_signal(number)
    assert command.wait(30) == 128 + number
    assert not lives(node)
