# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is called where no answer is handled meanwhile."""

import threading

from processes import Client
import pytest
from rclpy.node import Node
from tap_ros.nodes.clients import CallError, in_executor


def test_a_function_is_called_in_the_thread_that_spins():
    with Client() as node:
        thread = in_executor(node, threading.current_thread, 10.0)
        assert thread.name == 'spinner'
        with pytest.raises(ZeroDivisionError):
            in_executor(node, lambda: 1 / 0, 10.0)
        assert in_executor(node, threading.current_thread, 10.0) is thread, 'it spins on'
        idle = Node('idle', context=node.context)
        with pytest.raises(CallError, match='idle is not spun'):
            in_executor(idle, threading.current_thread, 10.0)
        idle.destroy_node()
