# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who has sent a goal of reach_goal, and whether that program is still there."""

from collections.abc import Callable

from rclpy.node import Node
from tap_ros.base.contract import NODE_CLASSES
from tap_ros.ros.heartbeat import Presence
from tap_ros.ros.subscriptions import PROCESS_BYTES, processes, UNKNOWN

ACTION = 'reach_goal'
FEEDBACK = f'{ACTION}/_action/feedback'
CLIENT = 'tap_ros_client_'  # begins the name of a Client's own node


def watch_sender(node: Node, goal_id: bytes) -> Callable[[], bool]:
    """
    Return a function that tells whether who has sent a goal has left the ROS graph.

    A Client of this package is known by the id. Other programs listen to the feedback of their
    goals: none may be left of those that did when the goal was accepted. Our own programs listen,
    too, but have not sent a goal whose id names none of them.

    :param node: that serves the goal; goal_id: its 16 bytes.
    """
    def there() -> set[bytes]:
        return {*listeners(node)}

    def strangers() -> set[bytes]:
        return {process for process, names in listeners(node).items()
                if any(name not in {UNKNOWN, *NODE_CLASSES} and not name.startswith(CLIENT)
                       for name in (full.rpartition('/')[2] for full in names))}

    sender = Presence(lambda: there() & {goal_id[:PROCESS_BYTES]})
    others, anybody = Presence(strangers), Presence(there)
    return lambda: sender.gone or (not sender.there and (others.gone or anybody.gone))


def listeners(node: Node) -> dict[bytes, set[str]]:
    """Return the processes and nodes that take feedback, as those do who have sent a goal."""
    return processes(
        node.get_subscriptions_info_by_topic(node.resolve_topic_name(FEEDBACK)))
