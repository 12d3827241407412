# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topic qualities and times that several nodes share."""

from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

# Reliable and kept for late joiners: goals, the last subgoal.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Reliable, for everything that happens at control rate.
STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE,
                    durability=DurabilityPolicy.VOLATILE)
# Of servers: requests that wait to be taken, answers that wait to be received. Of clients: answers
# that wait to be taken, those to all other clients among them, since every client receives all.
# With the default depth of 10, DDS drops what comes beyond without a word.
SERVICE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


def to_stamp(nanoseconds: int) -> Time:
    """Return builtin_interfaces/Time."""
    seconds, rest = divmod(int(nanoseconds), 10**9)
    return Time(sec=seconds, nanosec=rest)


def to_nanoseconds(stamp: Time) -> int:
    """Return the nanoseconds of a builtin_interfaces/Time."""
    return stamp.sec * 10**9 + stamp.nanosec
