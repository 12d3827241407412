# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run a node without the command ros2: python -m tap_ros.nodes NAME --ros-args ..."""

import sys

from tap_ros.base.contract import NODE_CLASSES
from tap_ros.base.text import meant
from tap_ros.ros.run import main

if __name__ == '__main__':
    if len(sys.argv) < 2 or sys.argv[1] not in NODE_CLASSES:
        near = meant(sys.argv[1], NODE_CLASSES) if len(sys.argv) > 1 else ''
        sys.exit(f'error: expected the name of a node; {near}valid: {", ".join(NODE_CLASSES)}')
    sys.exit(main(sys.argv[1], sys.argv[2:]))
