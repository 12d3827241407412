# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes, and what talks to them: the only part that needs ROS and tap_msgs."""

from importlib.util import find_spec
import sys

from tap_ros.base.contract import NODE_CLASSES
from tap_ros.base.errors import ConfigError

for _name in ('rclpy', 'tap_msgs'):
    if getattr(find_spec(_name), 'origin', None) is None:  # none of a folder of a checkout
        _lack = (f'{_name} is not there, which nodes and those who talk to them need; build ROS 2 '
                 'and tap_msgs in a checkout and enter its environment (docs/ros.md)')
        if sys.argv[:1] == ['-m'] or sys.argv and sys.argv[0].endswith(tuple(NODE_CLASSES)):
            sys.exit(f'error: {_lack}')  # it is a node that is started
        raise ConfigError(_lack)
