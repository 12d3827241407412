# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fast DDS for the nodes: it forgets a dead process soon, and a restarted one is heard."""

from collections.abc import MutableMapping
import os
from pathlib import Path

SUBNET = Path(__file__).with_name('fastdds_subnet.xml')
LOCALHOST = Path(__file__).with_name('fastdds_localhost.xml')
PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
CHOICES = (PROFILE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS')
FAST_DDS = (None, '', 'rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp')
RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
LOCALHOST_ONLY = 'ROS_LOCALHOST_ONLY'  # older than RANGE, and still stronger


def configure_fast_dds(environ: MutableMapping[str, str] = os.environ) -> None:
    """
    Let Fast DDS give up this process 3 s after its death, and use UDP alone.

    By default it waits for 20 s, and until then others send calls of its services to it. Much
    less than 3 s is too little on a loaded machine: a node that is given up and comes back can
    lose what is sent to it for a while. Shared memory is left out as Fast DDS 2.14 loses what a
    process sends to one that was killed and started again (its pull request 4728).

    To be called before rclpy.init. Another middleware, and profiles or transports that the user
    has chosen, are left alone; so is LOCALHOST with ROS_STATIC_PEERS, where rmw_fastrtps adds
    shared memory.

    :param environ: the variables of this process, which rclpy.init reads.
    """
    if environ.get('RMW_IMPLEMENTATION') not in FAST_DDS or any(
            name in environ for name in CHOICES):
        return
    profile = SUBNET
    alone = environ.get(LOCALHOST_ONLY) == '1'
    local = alone or environ.get(RANGE, '').upper() == 'LOCALHOST'
    if local and (alone or not environ.get('ROS_STATIC_PEERS')):
        profile = LOCALHOST
    if not profile.is_file():  # without it the range must stay as it is
        return
    environ[PROFILE] = str(profile)
    if profile is LOCALHOST:  # rmw_fastrtps leaves the system's default alone
        environ.pop(LOCALHOST_ONLY, None)
        environ[RANGE] = 'SYSTEM_DEFAULT'
