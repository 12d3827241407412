# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Subscriptions that hear every publisher, whatever quality of service it offers.

A subscription that asks for more than is offered gets nothing, without a word. So each asks for
what its publishers offer, unless a parameter qos_overrides.TOPIC.subscription.POLICY says what.
"""

from collections.abc import Callable
import copy
from typing import Any, TYPE_CHECKING

from rclpy.exceptions import ParameterException
from rclpy.qos import (
    DurabilityPolicy,
    qos_check_compatible,
    QoSCompatibility,
    QoSPolicyKind,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from tap_ros.errors import ConfigError
from tap_ros.text import escaped, listing

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription

LOOK_PERIOD = 0.5  # s between two looks at what is offered
_OVERRIDABLE = QoSOverridingOptions((
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY))


def subscribe(node: 'Node', message_type: type, topic: str, callback: Callable[..., Any],
              qos: 'QoSProfile', callback_group: 'CallbackGroup | None' = None,
              options: QoSOverridingOptions | None = _OVERRIDABLE) -> 'Subscription':
    """
    Subscribe to a topic, heeding the parameters qos_overrides.*.

    :param callback: takes a message, or a message and its info.
    :param qos: QoSProfile; it stays as it is, while rclpy writes overrides into what it is given.
    :param options: which of them are heeded; None: none.
    :raises ConfigError: for a parameter that no quality of service has.
    """
    try:
        return node.create_subscription(
            message_type, topic, callback, copy.copy(qos), callback_group=callback_group,
            qos_overriding_options=options)
    except (ValueError, KeyError, TypeError, RuntimeError, ParameterException,
            InvalidQosOverridesError) as error:
        raise ConfigError(
            f'parameters qos_overrides.{node.resolve_topic_name(topic)}.subscription.*: '
            f'{escaped(error, 200)}; valid are history (keep_last, keep_all), depth (a number), '
            'reliability (reliable, best_effort), durability (volatile, transient_local)'
        ) from error


class Heard:
    """
    One subscription; call look_after now and then.

    :param node: rclpy Node.
    :param message_type: class of the messages.
    :param topic: name of the topic.
    :param callback: takes a message, or a message and its info.
    :param qos: QoSProfile to ask for while nothing less is offered.
    :param callback_group: callback group, None for the node's own.
    :ivar topic: full name of the topic.
    :ivar subscription: rclpy Subscription of the moment.
    """

    def __init__(self, node: 'Node', message_type: type, topic: str, callback: Callable[..., Any],
                 qos: 'QoSProfile', callback_group: 'CallbackGroup | None' = None) -> None:
        self.topic = node.resolve_topic_name(topic)
        self._node, self._type, self._callback = node, message_type, callback
        self._group, self._full = callback_group, copy.copy(qos)
        self._prefix = f'qos_overrides.{self.topic}.subscription.'
        self._fixed = any(name.startswith(self._prefix) for name in node._parameter_overrides)
        self._qos = copy.copy(qos)
        self.subscription = subscribe(node, message_type, topic, callback, qos, callback_group)

    def look_after(self) -> None:
        """Ask for what is offered, if that has changed."""
        offered = [one.qos_profile for one in self._publishers()]
        if self._fixed or not offered:
            return
        wanted = copy.copy(self._full)
        if any(one.reliability == ReliabilityPolicy.BEST_EFFORT for one in offered):
            wanted.reliability = ReliabilityPolicy.BEST_EFFORT
        # Never transient local again: what others keep is older than what has come since.
        if self._qos.durability == DurabilityPolicy.VOLATILE or any(
                one.durability == DurabilityPolicy.VOLATILE for one in offered):
            wanted.durability = DurabilityPolicy.VOLATILE
        if (wanted.reliability, wanted.durability) == (
                self._qos.reliability, self._qos.durability):
            return
        self._qos = wanted
        self._node.get_logger().info(
            f'{escaped(self.topic)}: taken {wanted.reliability.name.lower()} and '
            f'{wanted.durability.name.lower()}, as it is published')
        self._node.destroy_subscription(self.subscription)
        self.subscription = subscribe(
            self._node, self._type, self.topic, self._callback, wanted, self._group, None)

    def why_silent(self) -> str:
        """Say why nothing can come, '' if something can."""
        publishers = self._publishers()
        if not publishers:
            return 'no node publishes it'
        reasons = []
        for one in publishers:
            compatible, reason = qos_check_compatible(one.qos_profile, self._qos)
            if compatible != QoSCompatibility.ERROR:
                return ''
            reasons.append(f'{one.node_name}: {reason.removeprefix("ERROR: ").rstrip(";")}')
        return (f'its quality of service does not fit, {escaped(listing(reasons, 3), 300)}; '
                f'see the parameters {self._prefix}*')

    def _publishers(self) -> list[Any]:
        """Return what is known of those who publish."""
        return self._node.get_publishers_info_by_topic(self.topic)


def named_with_reason(heard: Heard | None, name: str) -> str:
    """Return the name of a topic, and why nothing comes on it where that is known."""
    why = heard.why_silent() if heard is not None else ''
    return f'{name} ({why})' if why else name
