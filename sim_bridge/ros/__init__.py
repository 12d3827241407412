# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator as a node."""

import tap_ros.nodes  # noqa: F401  says what is missing where ROS is
