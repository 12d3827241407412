# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Heartbeats: the death of a node is noticed within a second."""

import threading
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header
from tap_ros.nodes.observations import reception_time
from tap_ros.text import escaped

BEAT_S = 0.1
LEASE_S = 0.4  # of the topic's liveliness, for other programs that watch it
SILENT_S = 0.7  # s without a beat after which a node may be dead
DOUBT_S = 0.1  # s more until it counts as dead: the watcher itself may have been delayed
QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                 liveliness=LivelinessPolicy.AUTOMATIC,
                 liveliness_lease_duration=Duration(seconds=LEASE_S))


class Heartbeat:
    """
    Publish <node>/heartbeat ten times a second.

    A thread does it: a long callback is no death; a killed or stopped process is.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(Header, '~/heartbeat', QOS)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name='heartbeat', daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop the thread; to be called before the node is destroyed."""
        self._ended.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        while not self._ended.wait(BEAT_S):
            try:
                self._publisher.publish(Header(stamp=self._node.get_clock().now().to_msg()))
            except Exception as error:  # a thread that ends would make a living node look dead
                self._node.get_logger().error(
                    f'heartbeat: {escaped(error)}', throttle_duration_sec=1.0)


class Liveness:
    """
    Watch the heartbeat of a node.

    Fast DDS also reports the loss of liveliness, but not always for a node that was restarted soon
    after its death; so only the beats count.

    :param node: rclpy Node that watches; another thread spins it.
    :param name: of the node that is watched, as seen from this one's namespace.
    :param callback_group: callback group, None for the node's own.
    """

    def __init__(self, node: Node, name: str,
                 callback_group: CallbackGroup | None = None) -> None:
        self.name = name
        self._beat_at: float | None = None  # monotonic time of the newest beat
        self._doubted_at: float | None = None  # when its silence was seen first
        self._changed = threading.Condition()
        node.create_subscription(
            Header, f'{name}/heartbeat', self._on_beat,  # type: ignore[arg-type]  # with the info
            QOS, callback_group=callback_group)

    @property
    def dead(self) -> bool:
        """Return whether the beats of a node have stopped; to be polled."""
        now = time.monotonic()
        if not self._silent(now):
            self._doubted_at = None
        elif self._doubted_at is None:
            self._doubted_at = now
        doubted_at = self._doubted_at
        return doubted_at is not None and now - doubted_at > DOUBT_S

    def wait_until_alive(self, seconds: float) -> bool:
        """Wait until a dead node lives again; return whether it does, or was never alive."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._silent(time.monotonic()), seconds)

    def _silent(self, now: float) -> bool:
        beat_at = self._beat_at
        return beat_at is not None and now - beat_at > SILENT_S

    def _on_beat(self, _: Header, info: dict[str, Any]) -> None:
        with self._changed:
            self._beat_at = reception_time(info)
            self._changed.notify_all()
