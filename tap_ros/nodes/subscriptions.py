# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Subscriptions that match the quality of service of whatever publishes.

A subscription that asks for more than is offered receives nothing, without an error. So each asks
for what its publishers offer, unless a parameter qos_overrides.TOPIC.subscription.POLICY is set.
"""

from collections.abc import Callable, Iterable
import copy
from typing import Any, TYPE_CHECKING

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
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
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription

ADAPT_PERIOD = 0.5  # s between two comparisons with what is offered
_OVERRIDABLE = QoSOverridingOptions((
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY))


class PollOnlyGroup(CallbackGroup):
    """Callback group that wakes no executor: messages wait until they are taken."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: no callback is ever due."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return False: no callback may begin."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing, since no callback has begun."""


def subscribe(node: 'Node', message_type: type, topic: str, callback: Callable[..., Any],
              qos: 'QoSProfile', callback_group: CallbackGroup | None = None,
              options: QoSOverridingOptions | None = _OVERRIDABLE,
              raw: bool = False) -> 'Subscription':
    """
    Subscribe to a topic, applying the parameters qos_overrides.*.

    :param callback: takes a message, or a message and its info.
    :param qos: QoSProfile; copied, since rclpy writes overrides into the one it is given.
    :param options: which overrides are applied; None: none.
    :param raw: deliver serialized messages.
    :raises ConfigError: for an override with an invalid value.
    """
    try:
        return node.create_subscription(
            message_type, topic, callback, copy.copy(qos), callback_group=callback_group,
            qos_overriding_options=options, raw=raw)
    except (ValueError, KeyError, TypeError, RuntimeError, ParameterException,
            InvalidQosOverridesError) as error:
        raise ConfigError(
            f'parameters qos_overrides.{node.resolve_topic_name(topic)}.subscription.*: '
            f'{escaped(error, 200)}; valid are history (keep_last, keep_all), depth (a number), '
            'reliability (reliable, best_effort), durability (volatile, transient_local)'
        ) from error


class AdaptiveSubscription:
    """
    One subscription whose quality of service follows its publishers; adapt() has to be called.

    :param callback: takes a message, or a message and its info.
    :param qos: QoSProfile to ask for while nothing less is offered.
    :param callback_group: callback group, None for the node's own.
    :param raw: deliver serialized messages.
    :ivar topic: full name of the topic.
    :ivar qos: QoSProfile that is asked for now.
    :ivar subscription: rclpy Subscription that is in use now.
    """

    def __init__(self, node: 'Node', message_type: type, topic: str, callback: Callable[..., Any],
                 qos: 'QoSProfile', callback_group: CallbackGroup | None = None,
                 raw: bool = False) -> None:
        self.topic = node.resolve_topic_name(topic)
        self._node, self._full, self._raw = node, copy.copy(qos), raw
        self._type, self._callback, self._group = message_type, callback, callback_group
        self._prefix = f'qos_overrides.{self.topic}.subscription.'
        self._fixed = any(name.startswith(self._prefix) for name in node._parameter_overrides)
        self.subscription = subscribe(
            node, message_type, topic, callback, qos, callback_group, raw=raw)
        self.qos = self.subscription.qos_profile if self._fixed else copy.copy(qos)

    def adapt(self) -> None:
        """Subscribe anew if the offered quality of service has changed."""
        offered = [one.qos_profile for one in self._publishers()]
        if self._fixed or not offered:
            return
        wanted = copy.copy(self._full)
        if any(one.reliability == ReliabilityPolicy.BEST_EFFORT for one in offered):
            wanted.reliability = ReliabilityPolicy.BEST_EFFORT
        # Never transient local again: what others keep is older than what has come since.
        if self.qos.durability == DurabilityPolicy.VOLATILE or any(
                one.durability == DurabilityPolicy.VOLATILE for one in offered):
            wanted.durability = DurabilityPolicy.VOLATILE
        if (wanted.reliability, wanted.durability) == (self.qos.reliability, self.qos.durability):
            return
        self.qos = wanted
        self._node.get_logger().info(
            f'{escaped(self.topic)}: taken {wanted.reliability.name.lower()} and '
            f'{wanted.durability.name.lower()}, as it is published')
        self._node.destroy_subscription(self.subscription)
        self.subscription = subscribe(self._node, self._type, self.topic, self._callback, wanted,
                                      self._group, None, self._raw)

    def take(self, limit: int) -> list[tuple[Any, dict[str, Any]]]:
        """Return messages, with their info, that wait for a callback; at most `limit`."""
        taken: list[tuple[Any, dict[str, Any]]] = []
        subscription = self.subscription
        with subscription.handle:
            while len(taken) < limit:
                one = subscription.handle.take_message(subscription.msg_type, self._raw)
                if one is None:
                    break
                taken.append(one)
        return taken

    def why_silent(self) -> str:
        """Return why no message can arrive, '' if one can."""
        publishers = self._publishers()
        if not publishers:
            return 'no node publishes it'
        reasons = []
        for one in publishers:
            compatible, reason = qos_check_compatible(one.qos_profile, self.qos)
            if compatible != QoSCompatibility.ERROR:
                return ''
            reasons.append(f'{one.node_name}: {reason.removeprefix("ERROR: ").rstrip(";")}')
        return (f'its quality of service does not fit, {escaped(listing(reasons, 3), 300)}; '
                f'see the parameters {self._prefix}*')

    def _publishers(self) -> list[Any]:
        """Return what is known of those who publish."""
        return self._node.get_publishers_info_by_topic(self.topic)


def adapt_regularly(node: 'Node', subscriptions: Iterable[AdaptiveSubscription],
                    callback_group: CallbackGroup | None = None) -> None:
    """Call adapt() of these subscriptions, any iterable that may grow, every ADAPT_PERIOD."""
    def adapt() -> None:
        for subscription in list(subscriptions):
            subscription.adapt()

    node.create_timer(ADAPT_PERIOD, adapt, callback_group=callback_group,
                      clock=Clock(clock_type=ClockType.STEADY_TIME))
