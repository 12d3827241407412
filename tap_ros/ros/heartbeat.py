# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is known of other nodes: whether they are in the ROS graph, and how long silent."""

from collections.abc import Callable, Collection
import threading
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from tap_ros.base.text import escaped
from tap_ros.ros.observations import reception_time
from tap_ros.ros.subscriptions import publishers_of

BEAT_S = 0.1
QUIET_S = 1.0  # s without a beat from which on silence is worth a word
QOS = QoSProfile(depth=1)


class Heartbeat:
    """
    Publish <node>/heartbeat ten times a second.

    A thread does it, so a long callback is no silence.
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
            except Exception as error:  # a thread that ends would make a living node look silent
                self._node.get_logger().error(
                    f'heartbeat: {escaped(error)}', throttle_duration_sec=1.0)


class Presence:
    """
    Whether all that were in the ROS graph once, such as the servers of a call, have left it.

    The middleware removes a process that has ended, been killed, or stood still for longer than
    the lease of its DDS participant: 3 s as nodes set it up (see run.configure_fast_dds). A new
    process under the same name is another one; a busy one stays.

    :param look: returns what identifies those that are there now.
    :ivar there: what it returned first, where that was not nothing.
    """

    def __init__(self, look: Callable[[], Collection[bytes]]) -> None:
        self._look, self.there = look, frozenset(look())

    @property
    def gone(self) -> bool:
        """Whether none is there any more; not while none has been seen yet."""
        now = self._look()
        self.there = self.there or frozenset(now)  # those that have just started
        return bool(self.there) and self.there.isdisjoint(now)


def publishers_present(node: Node, topic: str) -> Presence:
    """Return the Presence of those that publish a topic now."""
    return Presence(lambda: set().union(*publishers_of(node, topic).values()))


class Liveness:
    """
    Watch another node: it may fall silent, and leave the ROS graph.

    :param node: rclpy Node that watches; another thread spins it.
    :param name: of the node that is watched, as seen from this one's namespace.
    :param callback_group: callback group, None for the node's own.
    """

    def __init__(self, node: Node, name: str,
                 callback_group: CallbackGroup | None = None) -> None:
        self.name, self._node = name, node
        self._topic = f'{name}/heartbeat'
        self._beat_at: float | None = None  # monotonic time of the newest beat
        node.create_subscription(
            Header, self._topic, self._on_beat,  # type: ignore[arg-type]  # with the info
            QOS, callback_group=callback_group)

    def presence(self) -> Presence:
        """Return the Presence of the processes that have this name now."""
        return publishers_present(self._node, self._topic)

    @property
    def silence(self) -> str:
        """Return for how long the node has been silent; '' where that is nothing unusual."""
        quiet_s = 0.0 if self._beat_at is None else time.monotonic() - self._beat_at
        return f'{self.name} has been silent for {quiet_s:.1f} s' if quiet_s > QUIET_S else ''

    def _on_beat(self, _: Header, info: dict[str, Any]) -> None:
        self._beat_at = reception_time(info)
