# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an arm would have been told, and when."""

from dataclasses import dataclass
import threading
import time

from geometry_msgs.msg import TwistStamped
from tap_ros.nodes.topics import STREAM, to_nanoseconds


@dataclass(frozen=True)
class Command:
    """A twist command that came."""

    at: float  # time.monotonic() of its arrival
    stamp_ns: int
    move: tuple  # metres

    @property
    def is_stop(self):
        """Whether it says to stand still."""
        return not any(self.move)


class Commands:
    """
    Keep every twist command, as a driver of the arm would get it.

    :param node: rclpy Node that another thread spins.
    """

    def __init__(self, node):
        self._kept = []
        self._changed = threading.Condition()
        node.create_subscription(TwistStamped, 'arm/delta_twist_cmds', self._put, STREAM)

    def since(self, moment):
        """Return the commands that came after a moment of time.monotonic()."""
        with self._changed:
            return [command for command in self._kept if command.at > moment]

    def moves(self, moment):
        """Return those after a moment that are no stops."""
        return [command for command in self.since(moment) if not command.is_stop]

    def forget(self):
        """Drop all."""
        with self._changed:
            self._kept.clear()

    def wait_for_moves(self, moment, count, timeout_s):
        """Wait until so many moves have come after a moment; tell whether they have."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while sum(c.at > moment and not c.is_stop for c in self._kept) < count:
                if not self._changed.wait(max(0.0, deadline - time.monotonic())):
                    return False
        return True

    def seconds_to_stop(self, moment):
        """
        Return the seconds from a moment to the stop after which nothing moved; inf without one.

        A stop that was sent before counts as 0 s where no move came after the moment.
        """
        with self._changed:
            kept = list(self._kept)
        moves = [index for index, command in enumerate(kept) if not command.is_stop]
        rest = kept[moves[-1] + 1 if moves else 0:]
        return max(0.0, rest[0].at - moment) if rest else float('inf')

    def _put(self, message):
        linear = message.twist.linear
        command = Command(time.monotonic(), to_nanoseconds(message.header.stamp),
                          (linear.x, linear.y, linear.z))
        with self._changed:
            self._kept.append(command)
            self._changed.notify_all()
