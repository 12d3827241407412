# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What nodes are set up with, parameters and Fast DDS; and that none outlives a command."""

from importlib import import_module
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from driven import Arm, goal_fields, World
from processes import Client, until
import pytest
from rclpy.context import Context
from rclpy.node import Node
import tap_ros
from tap_ros.apps.node_processes import errors_in
from tap_ros.base.contract import CLIMB_LIMIT, MOVE_LIMIT, NODE_CLASSES
from tap_ros.ros.parameters import MOUNT
from tap_ros.ros.run import configure_fast_dds, LOCALHOST, main, PROFILE, SUBNET, usage
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
        # All that are known; where the simulated arm stands, and how far it reaches.
        for own in ('topics', *MOUNT, 'x_min', 'x_max', 'y_min', 'y_max'):
            values.pop(own, None)
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


@pytest.mark.parametrize('words, said', [
    (['--help'], 'usage: sim_node --ros-args -p NAME:=VALUE'), (['-h'], 'usage: '),
    (['--ros-args', '-p', 'task:=push3', '--', '--help'], 'usage: '),
    (['-p', 'task:=push3'], 'error: argument -p is unknown; expected sim_node --ros-args -p '),
    (['--ros-args', '-p', 'task:=push3', '-r', '__ns:=/a'], None), ([], None),
    (['--ros-args', '-p', 'task'], None)])  # rclpy says what is wrong
def test_what_a_node_does_not_know_is_answered_before_it_starts(words, said):
    answer = usage('sim_node', words)
    assert answer is None if said is None else answer.startswith(said)
    if said:
        assert main('sim_node', words) == int(said.startswith('error'))


COMMAND = """
import sys, time
from tap_ros.apps.node_processes import NodeProcesses
with NodeProcesses(sys.argv[1]) as processes:
    processes.start('robot_mask_node')
    print(processes._processes['robot_mask_node'].pid, flush=True)
    time.sleep(600)
"""


def lives(pid):
    """Return whether such a process runs; one that nobody has waited for does not."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except (FileNotFoundError, ProcessLookupError):
        return False


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


@pytest.mark.slow
def test_a_planner_stops_the_arm_and_ends_when_who_started_it_is_killed(tmp_path):
    code = COMMAND.replace('robot_mask_node', 'visual_mpc_node').replace(
        "start('visual_mpc_node'", "start('visual_mpc_node', preset='quick', max_age=30.0")
    with (subprocess.Popen([sys.executable, '-c', code, str(tmp_path)], stdout=subprocess.PIPE,
                           text=True) as command,
          Client() as node, World(node), tap_ros.Client(node=node) as client):
        planner, arm = int(command.stdout.readline()), Arm(node)
        try:
            client.wait_until_ready('visual_mpc_node', timeout_s=60)
            next(iter(client.reach(**goal_fields())))  # it moves
            moment = time.monotonic()
            command.kill()
            assert until(lambda: not lives(planner))
            assert arm.moves(0)
            arm.assert_stopped(moment)
        finally:
            command.kill()
            if lives(planner):
                os.kill(planner, signal.SIGKILL)
    log = (tmp_path / 'visual_mpc_node.log').read_text()
    assert 'reach_goal ended' in log and not errors_in(log), log


SLOW = """
import os, signal, sys, time
from types import SimpleNamespace
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import String
from tap_ros.ros import run

class Slow(Node):
    num_threads = 4

    def __init__(self, **options):
        super().__init__('slow', **options)
        self.params, self.count = SimpleNamespace(given=set()), 0
        self.publisher = self.create_publisher(String, 'words', 1)
        self.create_timer(0.05, self.work, ReentrantCallbackGroup())

    def work(self):
        self.count += 1
        if self.count == 4:
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.5)
        self.publisher.publish(String())

    def close(self):
        return 0

run.NODE_CLASSES = {'slow': '__main__:Slow'}
sys.exit(run.main('slow', []))
"""


def test_a_callback_that_runs_when_the_node_is_ended_has_what_it_needs():
    run = subprocess.run([sys.executable, '-c', SLOW], capture_output=True, text=True, timeout=300)
    assert (run.returncode, run.stderr) == (0, '')
