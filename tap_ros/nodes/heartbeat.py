# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Heartbeats: the death of a node is noticed within a second."""

import threading
import time

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from tap_ros.nodes.observations import reception_time

BEAT_S = 0.1
LEASE_S = 0.4  # after so long without a sign of life a node is thought dead
LATE_S = 0.25  # a beat within this time after the loss shows that another one lives
QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                 liveliness=LivelinessPolicy.AUTOMATIC,
                 liveliness_lease_duration=Duration(seconds=LEASE_S))


class Heartbeat:
    """
    Publish <node>/heartbeat ten times a second.

    The middleware itself asserts that the process lives, so a long callback is no death; a killed
    or stopped process is.

    :param node: rclpy Node.
    """

    def __init__(self, node):
        self._node = node
        self._publisher = node.create_publisher(Header, '~/heartbeat', QOS)
        node.create_timer(BEAT_S, self._beat, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _beat(self):
        self._publisher.publish(Header(stamp=self._node.get_clock().now().to_msg()))


class Liveness:
    """
    Watch the heartbeat of a node.

    The middleware tells the loss of a heartbeat; the beats themselves tell that there is one. The
    numbers of those alive that Fast DDS keeps are wrong after a restart, below zero even.

    :param node: rclpy Node that watches; another thread spins it.
    :param name: of the node that is watched, as seen from this one's namespace.
    :param callback_group: callback group, None for the node's own.
    """

    def __init__(self, node, name, callback_group=None):
        self.name = name
        self._died_at = None  # monotonic time; None while one is alive, or none has died yet
        self._changed = threading.Condition()
        node.create_subscription(
            Header, f'{name}/heartbeat', self._on_beat, QOS, callback_group=callback_group,
            event_callbacks=SubscriptionEventCallbacks(liveliness=self._on_liveliness))

    def wait_until_alive(self, seconds):
        """Wait until one that has died lives again; tell so, and True if none has died yet."""
        with self._changed:
            return self._changed.wait_for(lambda: self._died_at is None, seconds)

    @property
    def dead(self):
        """
        Tell whether it has died for sure.

        The loss of one that was started again, or a sign of life that comes late on a machine that
        is short of time, is no death.
        """
        died_at = self._died_at
        return died_at is not None and time.monotonic() - died_at > LATE_S

    def _on_beat(self, _, info):
        with self._changed:
            if self._died_at is not None and reception_time(info) > self._died_at:
                self._died_at = None
                self._changed.notify_all()

    def _on_liveliness(self, event):
        with self._changed:
            lost = event.alive_count_change < 0 or event.not_alive_count_change > 0
            if lost and self._died_at is None:
                self._died_at = time.monotonic()
