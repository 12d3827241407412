# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS domains that no other test run on this machine uses."""

import os
import socket

NODES = 30  # whose ports are looked at
_held = []  # sockets, open until this process ends


def reserve_domain():
    """
    Return a ROS domain that this process alone has reserved.

    Whoever holds the TCP port of that number has the domain. One with a UDP port of DDS in use has
    nodes of somebody else.
    """
    for turn in range(100):
        domain = 1 + (os.getpid() + turn) % 100
        claim = socket.socket()
        try:
            claim.bind(('127.0.0.1', 7400 + 250 * domain))
            for node in range(NODES):
                with socket.socket(type=socket.SOCK_DGRAM) as port:
                    port.bind(('', 7410 + 250 * domain + 2 * node))
        except OSError:
            claim.close()
            continue
        _held.append(claim)
        return domain
    raise RuntimeError('all 100 ROS domains are in use on this machine')
