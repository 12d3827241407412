# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node that dies and comes back is known to be dead, then alive, and is heard."""

from pathlib import Path
import signal
import time

from processes import Client, NodeProcess
import pytest
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.clients import call, CallError, Newest
from tap_ros.nodes.heartbeat import Liveness, QOS
from tap_ros.nodes.run import configure_fast_dds, LOCALHOST, SUBNET

PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


@pytest.fixture
def recorder(tmp_path):
    """Return a function that starts a recorder node; all of them are killed in the end."""
    started = []

    def start():
        process = NodeProcess(
            'recorder_node', tmp_path / f'{len(started)}.log',
            {'folder': tmp_path / 'bag', 'record_on_start': 'false'})
        started.append(process)
        return process.wait_for('ready')

    yield start
    for process in started:
        process.kill()


def test_every_death_is_noticed_and_every_return(recorder):
    with Client() as node:
        client = node.create_client(SetBool, 'recorder/record')
        alive = Liveness(node, 'recorder_node')
        beats = Newest(node, Header, 'recorder_node/heartbeat', QOS)
        for _ in range(4):  # soon after each other: Fast DDS has not given up the one before
            begun_ns = time.time_ns()
            process = recorder()
            beats.wait(20.0, lambda beat, begun_ns=begun_ns: to_nanoseconds(beat.stamp) > begun_ns)
            assert alive.wait_until_alive(10.0)
            assert call(client, SetBool.Request(data=False), 10.0, server=alive).success
            process.process.send_signal(signal.SIGSTOP)
            deadline = time.monotonic() + 10.0
            while not alive.dead:
                assert time.monotonic() < deadline, 'it is still thought alive'
                time.sleep(0.01)
            with pytest.raises(CallError, match='recorder_node, has ended'):
                call(client, SetBool.Request(data=False), 10.0, server=alive)
            process.process.kill()


def test_no_node_listens_on_shared_memory(recorder):
    process = recorder()
    maps = Path(f'/proc/{process.process.pid}/maps').read_text()
    assert 'libfastrtps' in maps and '/dev/shm/fast' not in maps


@pytest.mark.parametrize('variables, profile, discovery', [
    ({}, SUBNET, None),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, SUBNET, 'SUBNET'),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, LOCALHOST, 'SYSTEM_DEFAULT'),
    ({'ROS_LOCALHOST_ONLY': '1'}, LOCALHOST, 'SYSTEM_DEFAULT'),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_STATIC_PEERS': '10.0.0.1'}, SUBNET,
     'LOCALHOST'),
    ({'ROS_LOCALHOST_ONLY': '1', 'ROS_STATIC_PEERS': '10.0.0.1'}, LOCALHOST, 'SYSTEM_DEFAULT'),
    ({'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
     None, 'LOCALHOST'),
    ({'FASTDDS_BUILTIN_TRANSPORTS': 'LARGE_DATA'}, None, None),
    ({PROFILES: 'mine.xml', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}, 'mine.xml',
     'LOCALHOST')])
def test_what_the_user_has_chosen_is_kept(variables, profile, discovery):
    variables = dict(variables)
    configure_fast_dds(variables)
    assert variables.get(PROFILES) == (profile and str(profile))
    assert variables.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == discovery
