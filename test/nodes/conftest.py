# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes and clients of these tests talk among themselves only."""

import os

os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
