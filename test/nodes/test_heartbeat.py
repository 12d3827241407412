# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node that dies and comes back is known to be dead, then alive, and is heard."""

from pathlib import Path
import signal
import threading
import time

from processes import Client, Newest, NodeProcess, until
import pytest
from rclpy.node import Node
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import call, CallError, in_executor
from tap_ros.nodes.heartbeat import Liveness, QOS
from tap_ros.nodes.run import configure_fast_dds, LOCALHOST, PROFILE, SUBNET


def test_every_death_is_noticed_and_every_return(tmp_path):
    with Client() as node:
        client = node.create_client(SetBool, 'recorder/record')
        alive = Liveness(node, 'recorder_node')
        beats = Newest(node, Header, 'recorder_node/heartbeat', QOS)
        for number in range(2):  # soon after each other: Fast DDS has not given up the one before
            begun_ns = time.time_ns()
            process = NodeProcess('recorder_node', tmp_path / f'{number}.log', {
                'folder': tmp_path / 'bag', 'record_on_start': 'false'})
            try:
                process.wait_for('ready')
                beats.wait(20.0, lambda beat, after=begun_ns: to_nanoseconds(beat.stamp) > after)
                assert alive.wait_until_alive(10.0)
                assert call(client, SetBool.Request(data=False), 10.0, server=alive).success
                maps = Path(f'/proc/{process.process.pid}/maps').read_text()
                assert 'libfastrtps' in maps and '/dev/shm/fast' not in maps, 'no shared memory'
                process.process.send_signal(signal.SIGSTOP)
                assert until(lambda: alive.dead, 10)
                with pytest.raises(CallError, match='recorder_node, has ended'):
                    call(client, SetBool.Request(data=False), 10.0, server=alive)
            finally:
                process.kill()


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


def test_a_function_is_called_in_the_thread_that_spins(client):
    thread = in_executor(client, threading.current_thread, 10.0)
    assert thread.name == 'spinner'
    with pytest.raises(ZeroDivisionError):
        in_executor(client, lambda: 1 / 0, 10.0)
    assert in_executor(client, threading.current_thread, 10.0) is thread, 'it spins on'
    idle = Node('idle', context=client.context)
    with pytest.raises(CallError, match='idle is not spun'):
        in_executor(idle, threading.current_thread, 10.0)
    idle.destroy_node()
