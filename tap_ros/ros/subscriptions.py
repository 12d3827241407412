# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Subscriptions that match the quality of service of whatever publishes.

A subscription that asks for more than is offered receives nothing, without an error. So each asks
for what its publishers offer.
"""

from collections.abc import Callable, Iterable, Mapping
import copy
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo
from tap_ros.base.contract import NODE_CLASSES
from tap_ros.base.text import escaped, listing
from tap_ros.messages.topics import COMPRESSED_TYPE, IMAGE_TYPE, TOPICS

OURS = NODE_CLASSES.keys() - {'sim_node'}  # nodes whose pictures are no camera's
UNKNOWN = '_NODE_NAME_UNKNOWN_'  # of a publisher that was discovered before its node
ADAPT_PERIOD = 0.5  # s between two comparisons with what is offered
PROCESS_BYTES = 12  # of an endpoint's id, by which the endpoints of one process begin

# rclpy would warn that nothing arrives, before it is subscribed anew and does.
_QUIET = SubscriptionEventCallbacks(use_default_callbacks=False)

Publishers = Mapping[str, Mapping[bytes, set[str]]]  # of each topic: {process: its nodes}


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

    def __init__(self, node: Node, message_type: type, topic: str, callback: Callable[..., Any],
                 qos: QoSProfile, callback_group: CallbackGroup | None = None,
                 raw: bool = False) -> None:
        self.topic = node.resolve_topic_name(topic)
        self._node, self._raw, self._full, self.qos = node, raw, qos, qos
        self._type, self._callback, self._group = message_type, callback, callback_group
        self._subscribe()

    def adapt(self) -> None:
        """Subscribe anew if the offered quality of service has changed."""
        offered = [one.qos_profile
                   for one in self._node.get_publishers_info_by_topic(self.topic)]
        wanted = copy.copy(self._full)
        if any(one.reliability == ReliabilityPolicy.BEST_EFFORT for one in offered):
            wanted.reliability = ReliabilityPolicy.BEST_EFFORT
        # Never transient local again: what others keep is older than what has come since.
        if self.qos.durability == DurabilityPolicy.VOLATILE or any(
                one.durability == DurabilityPolicy.VOLATILE for one in offered):
            wanted.durability = DurabilityPolicy.VOLATILE
        if not offered or (wanted.reliability, wanted.durability) == (
                self.qos.reliability, self.qos.durability):
            return
        self.qos = wanted
        self._node.get_logger().info(
            f'{escaped(self.topic)}: taken {wanted.reliability.name.lower()} and '
            f'{wanted.durability.name.lower()}, as it is published')
        self._node.destroy_subscription(self.subscription)
        self._subscribe()

    def why_silent(self) -> str:
        """Return why no message can arrive, and the remedy; '' if one can."""
        return why_silent(self._node, self.topic, self._type)

    def _subscribe(self) -> None:
        self.subscription = self._node.create_subscription(
            self._type, self.topic, self._callback, self.qos, callback_group=self._group,
            event_callbacks=_QUIET, raw=self._raw)


def adapt_regularly(node: Node, subscriptions: Iterable[AdaptiveSubscription],
                    callback_group: CallbackGroup | None = None) -> None:
    """Call adapt() of these subscriptions, any iterable that may grow, every ADAPT_PERIOD."""
    def adapt() -> None:
        for subscription in list(subscriptions):
            subscription.adapt()

    steady_timer(node, ADAPT_PERIOD, adapt, callback_group)


def steady_timer(node: Node, period_s: float, callback: Callable[[], object],
                 callback_group: CallbackGroup | None = None) -> Timer:
    """Call something regularly, also where /clock stands still."""
    return node.create_timer(period_s, callback, callback_group,
                             clock=Clock(clock_type=ClockType.STEADY_TIME))


def processes(infos: Iterable[TopicEndpointInfo]) -> dict[bytes, set[str]]:
    """Return {process: full names of its nodes} of publishers or subscribers of a topic."""
    found: dict[bytes, set[str]] = {}
    for info in infos:  # the DDS participant is known before all topics and nodes of it
        found.setdefault(bytes(info.endpoint_gid[:PROCESS_BYTES]), set()).add(
            f'{info.node_namespace.rstrip("/")}/{info.node_name}')
    return found


def publishers_of(node: Node, *topics: str) -> dict[str, dict[bytes, set[str]]]:
    """Return {full name of the topic: {process: full names of its nodes}}."""
    return {topic: processes(node.get_publishers_info_by_topic(topic))
            for topic in map(node.resolve_topic_name, topics)}


def rivals(found: Publishers, known: Publishers = MappingProxyType({})) -> str:
    """
    Say who publish a topic where several do and one, such as a second camera, is new; else ''.

    :param found: what publishers_of returns, of topics of which there may be one publisher.
    :param known: what it returned before; by default all are new.
    """
    before: set[bytes] = set().union(*known.values())
    for topic, publishers in found.items():
        nodes = [name for names in publishers.values()
                 for name in {one for one in names if UNKNOWN not in one} or names]
        if len(nodes) > 1 and publishers.keys() - before:
            return f'{len(nodes)} nodes publish on {topic}, {listing(sorted(nodes))}'
    return ''


def why_silent(node: Node, topic: str, message_type: type | None) -> str:
    """
    Return why no message of a topic can arrive, what is published instead, and the remedy.

    :param topic: full name; message_type: class of its messages, None if that is not known.
    :return: '' where somebody publishes it.
    """
    kind = '' if message_type is None else (
        f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}')
    here = {one.topic_type for one in node.get_publishers_info_by_topic(topic)}
    if here and (not kind or kind in here):
        return ''
    offered = {name: {one.topic_type for one in node.get_publishers_info_by_topic(name)
                      if one.node_name not in {node.get_name(), UNKNOWN, *OURS}}
               for name, _ in node.get_topic_names_and_types()
               if name != topic and not _of_another_robot(node, name)}
    if here:
        why = f'what is published there is {listing(sorted(here))}; expected {kind}'
    else:
        why = 'no node publishes it'
    beside = {IMAGE_TYPE: (f'{topic}/compressed', COMPRESSED_TYPE, 'compressed'),
              COMPRESSED_TYPE: (topic.removesuffix('/compressed'), IMAGE_TYPE, 'raw')}
    other, other_kind, transport = beside.get(kind, ('', '', ''))
    start = f'start this node with -p image_transport:={transport}'
    if other_kind in offered.get(other, ()):
        return f'{why}; {escaped(other)} is: {start}'
    if other_kind in here:
        return f'{why}; {start} -r {escaped(other)}:={escaped(topic)}'
    alike = sorted(name for name, kinds in offered.items() if kind in kinds and not any(
        one.is_called(name) and not one.is_called(topic) for one in TOPICS))
    if not kind:
        alike = get_close_matches(topic, [name for name in offered if offered[name]], 3, 0.7)
    return why if not alike else (
        f'{why}; published are {listing(alike, 5)}: remap one, -r {topic}:={escaped(alike[0])}')


def _of_another_robot(node: Node, topic: str) -> bool:
    """Return whether a topic is in a namespace where other nodes of this package are."""
    own = node.get_namespace().rstrip('/')
    spaces = {space for name, space in node.get_node_names_and_namespaces()
              if name in NODE_CLASSES and space != '/'}
    if own:  # what has our name elsewhere, but for the root, is another robot's, too
        plain = topic.removesuffix('/compressed')
        spaces |= {plain.removesuffix(f'/{one.name}') for one in TOPICS if one.is_called(topic)}
    return any(space and topic.startswith(f'{space}/') and not f'{own}/'.startswith(f'{space}/')
               for space in spaces)
