# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What nodes are set up with, parameters and Fast DDS; and that none outlives a command."""

from importlib import import_module
import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest
from rclpy.context import Context
from rclpy.node import Node
from tap_ros.base.contract import CLIMB_LIMIT, MOVE_LIMIT, NODE_CLASSES
from tap_ros.ros.run import configure_fast_dds, LOCALHOST, PROFILE, SUBNET
import yaml

FILE = Path(__file__).parents[2] / 'config/tap_ros.yaml'
NODES = {key.removeprefix('/**/'): values['ros__parameters']
         for key, values in yaml.safe_load(FILE.read_text()).items()}


def declared(name, *arguments):
    """Return the values of the parameters that a node declares, started with arguments."""
    context = Context()
    context.init(args=['--ros-args', *arguments])
    node = Node(name, context=context)
    try:
        before = set(node.list_parameters([], 0).names)
        import_module(NODE_CLASSES[name].split(':')[0]).declare_parameters(node)
        return {key: node.get_parameter(key).value
                for key in set(node.list_parameters([], 0).names) - before}
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_the_file_has_every_parameter_with_its_default_and_reaches_the_nodes(tmp_path):
    assert set(NODES) == set(NODE_CLASSES)
    for name, written in NODES.items():
        values = declared(name)
        values.pop('topics', None)  # of recorder_node; all that are known
        if name == 'visual_mpc_node':  # neither more than the arm does, nor less
            assert (values['max_step_xy'], values['max_step_z']) == (MOVE_LIMIT, CLIMB_LIMIT)
        if name == 'predictor_node':  # there a file, here its name
            values['weights'] = Path(values['weights']).stem
        assert written == values
        assert {key: type(value) for key, value in written.items()} == {
            key: type(value) for key, value in values.items()}
        given = written | {
            key: not value if isinstance(value, bool) else 0.9 * value
            for key, value in written.items() if isinstance(value, (bool, float))}
        file = tmp_path / f'{name}.yaml'
        file.write_text(yaml.dump({f'/**/{name}': {'ros__parameters': given}}))
        values = declared(name, '--params-file', str(file))
        assert {key: values[key] for key in given} == given


def test_what_the_user_has_chosen_is_kept():
    discovery, localhost = 'ROS_AUTOMATIC_DISCOVERY_RANGE', {'ROS_LOCALHOST_ONLY': '1'}
    peers = {'ROS_STATIC_PEERS': '10.0.0.1'}
    for given, profile, reach in (
            ({}, SUBNET, None),
            ({discovery: 'SUBNET'}, SUBNET, 'SUBNET'),
            ({discovery: 'LOCALHOST'}, LOCALHOST, 'SYSTEM_DEFAULT'),
            (localhost, LOCALHOST, 'SYSTEM_DEFAULT'),
            ({discovery: 'LOCALHOST'} | peers, SUBNET, 'LOCALHOST'),
            (localhost | peers, LOCALHOST, 'SYSTEM_DEFAULT'),
            ({'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp', discovery: 'LOCALHOST'},
             None, 'LOCALHOST'),
            ({'FASTDDS_BUILTIN_TRANSPORTS': 'LARGE_DATA'}, None, None),
            ({PROFILE: 'mine.xml', discovery: 'LOCALHOST'}, 'mine.xml', 'LOCALHOST')):
        variables = dict(given)
        configure_fast_dds(variables)
        assert variables.get(PROFILE) == (profile and str(profile)), given
        assert variables.get(discovery) == reach, given


COMMAND = """
import sys, time
from tap_ros.apps.node_processes import NodeProcesses
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
