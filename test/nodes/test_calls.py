# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What nodes and clients stand on: how Fast DDS is set up, and who calls whom."""

import threading

import pytest
from rclpy.node import Node
from tap_ros.nodes.calls import CallError, in_executor
from tap_ros.nodes.run import configure_fast_dds, LOCALHOST, PROFILE, SUBNET


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
