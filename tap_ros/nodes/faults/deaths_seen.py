# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Notice the death of a node as any client can: its heartbeat's liveliness."""

import threading
import time

from rclpy.event_handler import SubscriptionEventCallbacks
from std_msgs.msg import Header
from tap_ros.nodes.heartbeat import QOS


class DeathWatch:
    """
    Watch <name>/heartbeat.

    :param node: rclpy Node that another thread spins.
    :param name: of the node that is watched.
    """

    def __init__(self, node, name):
        self._changed = threading.Condition()
        self._alive, self._died = 0, None
        node.create_subscription(
            Header, f'{name}/heartbeat', lambda _: None, QOS,
            event_callbacks=SubscriptionEventCallbacks(liveliness=self._on_liveliness))

    @property
    def alive(self):
        """How many heartbeats are alive."""
        return self._alive

    def wait_until_alive(self, timeout_s):
        """Wait for a heartbeat; tell whether one is there."""
        with self._changed:
            return self._changed.wait_for(lambda: self._alive > 0, timeout_s)

    def seconds_to_notice(self, moment, timeout_s=3.0):
        """Return the seconds from a time.monotonic() to the death; inf if not noticed."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while self._died is None or self._died < moment:
                if not self._changed.wait(max(0.0, deadline - time.monotonic())):
                    return float('inf')
            return self._died - moment

    def _on_liveliness(self, event):
        with self._changed:
            if event.alive_count < self._alive:
                self._died = time.monotonic()
            self._alive = event.alive_count
            self._changed.notify_all()
