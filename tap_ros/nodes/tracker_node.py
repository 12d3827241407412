# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable tracker_node as a module: python -m tap_ros.nodes.tracker_node."""

import sys

from tap_ros.nodes.tracker.node import main

if __name__ == '__main__':
    sys.exit(main())
