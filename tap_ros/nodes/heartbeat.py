# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Heartbeats: the death of a node is noticed within a second."""

import os
from pathlib import Path
import threading
import time

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header

LEASE_S = 0.4  # after so long without a sign of life a node is thought dead
LATE_S = 0.25  # that a sign of life may come after that
QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                 liveliness=LivelinessPolicy.AUTOMATIC,
                 liveliness_lease_duration=Duration(seconds=LEASE_S))
PROFILE = Path(__file__).with_name('fastdds.xml')
PROFILE_VARIABLES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')


class Heartbeat:
    """
    Publish <node>/heartbeat twice a second.

    The middleware itself asserts that the process lives, so a long callback is no death; a killed
    or stopped process is.

    :param node: rclpy Node.
    """

    def __init__(self, node):
        self._node = node
        self._publisher = node.create_publisher(Header, '~/heartbeat', QOS)
        node.create_timer(0.5, self._beat, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _beat(self):
        self._publisher.publish(Header(stamp=self._node.get_clock().now().to_msg()))


class Liveness:
    """
    Watch the heartbeat of a node.

    :param node: rclpy Node that watches; another thread spins it.
    :param name: of the node that is watched, as seen from this one's namespace.
    :param callback_group: callback group, None for the node's own.
    """

    def __init__(self, node, name, callback_group=None):
        self.name = name
        self._alive = 0
        self._died_at = None  # monotonic time; None while one is alive, or none has died yet
        self._changed = threading.Condition()
        node.create_subscription(
            Header, f'{name}/heartbeat', lambda _: None, QOS, callback_group=callback_group,
            event_callbacks=SubscriptionEventCallbacks(liveliness=self._on_liveliness))

    def wait_until_alive(self, seconds):
        """Wait until one that has died lives again; tell so, and True if none has died yet."""
        with self._changed:
            return self._changed.wait_for(lambda: self._died_at is None, seconds)

    @property
    def dead(self):
        """
        Tell whether it has died for sure.

        On a machine that is short of time a sign of life may come late.
        """
        died_at = self._died_at
        return died_at is not None and time.monotonic() - died_at > LATE_S

    def _on_liveliness(self, event):
        with self._changed:
            if event.alive_count:
                self._died_at = None
            elif self._alive:
                self._died_at = time.monotonic()
            self._alive = event.alive_count
            self._changed.notify_all()


def use_short_leases():
    """
    Let Fast DDS give up this process three seconds after its death, instead of twenty.

    Until then others would send their calls to it. To be called before rclpy.init; profiles that
    the user has chosen, and other middlewares, are left alone.
    """
    if not any(name in os.environ for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[1]] = str(PROFILE)
