# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable visual_mpc_node as a module: python -m tap_ros.nodes.visual_mpc_node."""

import sys

from tap_ros.nodes.planner.node import main

if __name__ == '__main__':
    sys.exit(main())
