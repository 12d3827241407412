# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of several topics, grouped by their stamp, with the time of their reception."""

from collections import deque, OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
import math
import threading
import time
from types import MappingProxyType
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage
from tap_ros.messages.stamps import PROOF, to_nanoseconds
from tap_ros.ros.polling import PollOnlyGroup, take_messages
from tap_ros.ros.subscriptions import ADAPT_PERIOD, adapt_regularly, AdaptiveSubscription

DEPTH = 10  # stamps remembered
JUMP_NS = 10 * 10**9  # a stamp that far ahead of all others is not believed at once
REMEMBERED = 100  # messages of a latched topic by which repetitions are recognised
POLL_LIMIT = 100  # messages of a topic taken by one poll; the rest comes with the next
POLL_S = 0.005  # between two polls while waiting
CLOCK_S = 1.0  # s after which nothing is known of a clock or driver that is silent


@dataclass(frozen=True)
class Moment:
    """Messages of one stamp."""

    stamp_ns: int
    messages: dict[str, Any]  # topic -> message
    received: float  # s, monotonic: when the one that was received first came


@dataclass
class _Topic:
    """What is known of a topic: stamps in ns, times monotonic in s."""

    newest: int | None = None  # stamp
    previous: int = 0  # the stamp before that
    received: float = -math.inf  # when its last message came
    repeated: float = -math.inf  # when a stamp came again
    suspects: list[int] = field(default_factory=list)  # stamps in a row that are not believed
    sent: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))


class Observations:
    """
    Groups messages that carry the same stamp; thread-safe.

    A stamp that goes back, or that is more than JUMP_NS ahead, is believed only when PROOF
    messages in a row agree: a single one is from a stray publisher, several are from another
    simulator or a bag that loops. Then everything earlier is forgotten, and `jumps` counts it.
    A stray that is less far ahead is dropped when the next message continues from the one before.

    A message that repeats the stamp of the one before keeps the time of reception of that one,
    since a driver that hangs sends such messages. It counts as received now only while /clock
    repeats one time, as a simulator does that waits for a command.

    :param topics: short names, for example 'image', 'objects'; the first is the one whose stamp
        counts, the others describe it.
    :param latched: messages are rare and may have any stamp: the newest is the last one received.
    :ivar count: grows with every message and every call of wake.
    :ivar jumps: how often the clock has jumped.
    """

    def __init__(self, *topics: str, latched: bool = False) -> None:
        self._topics, self._latched = {topic: _Topic() for topic in topics}, latched
        self._changed = threading.Condition()  # reentrant
        # stamp in ns -> {topic: (message, received)}
        self._by_stamp: OrderedDict[int, dict[str, tuple[Any, float]]] = OrderedDict()
        self._clock = -1, -math.inf, False  # ns, when it came, whether it said the same before
        self.count, self.jumps = 0, 0
        self._polled: list[AdaptiveSubscription] = []
        self._adapted = -math.inf  # monotonic time at which these were
        self._subscriptions: dict[str, AdaptiveSubscription] = {}

    def subscribe(self, node: Node, types: Mapping[str, tuple[type, str]], qos: QoSProfile,
                  callback_group: CallbackGroup | None = None,
                  on_message: Callable[[str], object] = lambda name: None,
                  others: Mapping[str, Callable[..., Any]] = MappingProxyType({})) -> None:
        """
        Subscribe to the topics; latched pictures may come on NAME/compressed, too.

        :param types: {short name: (message type, topic name)}.
        :param qos: QoSProfile of all of them.
        :param callback_group: None for the node's own. PollOnlyGroup: messages are taken only when
            something is asked of this object, as many as `qos` keeps.
        :param on_message: called with the topic name after each message.
        :param others: {short name: callback that takes message and info instead of `put`}.
        """
        on_demand = isinstance(callback_group, PollOnlyGroup)

        def put(topic: str, message: Any, info: dict[str, Any]) -> None:
            self.put(topic, message, reception_time(info), info.get('source_timestamp', 0))
            on_message(types[topic][1])

        def subscribe(topic: str, kind: type, name: str) -> AdaptiveSubscription:
            return AdaptiveSubscription(
                node, kind, name, others.get(topic, partial(put, topic)), qos, callback_group)

        self._subscriptions = {topic: subscribe(topic, *one) for topic, one in types.items()}
        made = [*self._subscriptions.values()]
        if self._latched and 'image' in types:
            made.append(subscribe('image', CompressedImage, f'{types["image"][1]}/compressed'))
        elif not self._latched and not on_demand:
            node.create_subscription(Clock, 'clock', self.on_clock, qos_profile_sensor_data,
                                     callback_group=callback_group)
        if not on_demand:
            adapt_regularly(node, made, callback_group)
        self._polled = made if on_demand else []

    def poll(self) -> None:
        """Take what has arrived, if that is done on demand alone."""
        with self._changed:  # all topics together, in the order of reception
            taken = sorted(((reception_time(info), one.subscription.callback, message, info)
                            for one in self._polled
                            for message, info in take_messages(one.subscription, POLL_LIMIT)),
                           key=lambda found: found[0])
            if time.monotonic() - self._adapted > ADAPT_PERIOD:
                self._adapted = time.monotonic()
                for one in self._polled:  # nothing waits in it now
                    one.adapt()
            for _, callback, message, info in taken:
                callback(message, info)

    def names(self, topics: Iterable[str], explained: bool = False) -> str:
        """Return the full names of topics; explained: with why nothing arrives, where known."""
        words = []
        for topic in topics:
            why, subscription = '', self._subscriptions[topic]
            if explained and time.monotonic() - self._topics[topic].repeated < CLOCK_S:
                why = 'its messages repeat one stamp'
            elif explained:
                why = subscription.why_silent()
            words.append(f'{subscription.topic} ({why})' if why else subscription.topic)
        return ', '.join(words)

    def put(self, topic: str, message: Any, received: float | None = None,
            sent_ns: int = 0) -> None:
        """
        Add a message with a header.

        :param received: monotonic time in seconds of its reception; None: now.
        :param sent_ns: when its publisher sent it, by its clock; 0: unknown. A latched message
            arrives again with each new subscription; repetitions are ignored.
        """
        stamp, state = to_nanoseconds(message.header.stamp), self._topics[topic]
        received = time.monotonic() if received is None else received
        with self._changed:
            if self._latched:
                if sent_ns and sent_ns in state.sent:
                    return
                state.sent.append(sent_ns)
            elif not self._believe(state, topic, stamp):
                return
            if stamp != state.newest:
                state.previous = stamp if state.newest is None else state.newest
            elif not self._latched and not self.time_stands:
                received, state.repeated = state.received, received
            state.newest, state.received = stamp, received
            self._by_stamp.setdefault(stamp, {})[topic] = message, received
            self._by_stamp.move_to_end(stamp)
            while len(self._by_stamp) > DEPTH * len(self._topics):
                self._by_stamp.popitem(last=False)
            self.wake()

    def note(self, topic: str, received: float) -> None:
        """Note the reception of a message of a topic that is kept elsewhere."""
        with self._changed:
            self._topics[topic].received = received
            self.wake()

    def on_clock(self, message: Clock) -> None:
        """Take a message of /clock."""
        now_ns = to_nanoseconds(message.clock)
        self._clock = now_ns, time.monotonic(), now_ns == self._clock[0]

    @property
    def time_stands(self) -> bool:
        """Return whether the last two messages of /clock, the newest of them recent, are equal."""
        _, received, same = self._clock
        return same and time.monotonic() - received < CLOCK_S

    def _believe(self, state: _Topic, topic: str, stamp: int) -> bool:
        """Return whether a stamp is used; forget all others when the clock has jumped to it."""
        if state.newest is not None and state.previous <= stamp < state.newest:
            # It goes on from the one before the newest, which was a stray.
            self._by_stamp.get(state.newest, {}).pop(topic, None)
            state.newest = state.previous
        clock = max([one.newest for one in self._topics.values() if one.newest is not None],
                    default=stamp)
        if (state.newest or 0) <= stamp <= clock + JUMP_NS:
            state.suspects.clear()
            return True
        if state.suspects and not 0 <= stamp - state.suspects[-1] <= JUMP_NS:
            state.suspects.clear()  # a stray of its own
        state.suspects.append(stamp)
        if len(state.suspects) < PROOF:
            return False
        self.jumps += 1
        self._by_stamp.clear()
        for one in self._topics.values():
            one.newest = None
            one.suspects.clear()
        return True

    def moments(self, *topics: str, after_ns: int = -1,
                since: float = -math.inf) -> list[Moment]:
        """
        Return the Moments that have all of `topics`, the newest first.

        :param after_ns: only what is stamped later than this.
        :param since: only what was received at or after this monotonic time.
        """
        self.poll()
        with self._changed:
            found = [Moment(stamp, {topic: message for topic, (message, _) in parts.items()},
                            min(parts[topic][1] for topic in topics))
                     for stamp, parts in reversed(self._by_stamp.items())
                     if stamp > after_ns and parts.keys() >= {*topics}]
        found = [moment for moment in found if moment.received >= since]
        return found if self._latched else sorted(found, key=lambda one: -one.stamp_ns)

    def newest(self, *topics: str, after_ns: int = -1,
               since: float = -math.inf) -> Moment | None:
        """Return the newest of these Moments, None if there is none."""
        return next(iter(self.moments(*topics, after_ns=after_ns, since=since)), None)

    def wait(self, topics: Collection[str], timeout_s: float, after_ns: int = -1,
             give_up: Callable[[], object] = lambda: False) -> Moment | None:
        """
        Wait for an observation.

        :param topics: what it must have.
        :param timeout_s: most seconds to wait.
        :param after_ns: only what is stamped later than this.
        :param give_up: asked at every change and ten times a second whether to stop waiting.
        :return: a Moment, or None when none came in time.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not give_up():
                found = self.newest(*topics, after_ns=after_ns)
                left = deadline - time.monotonic()
                if found is not None or left <= 0:
                    return found
                self._changed.wait(min(left, POLL_S if self._polled else 0.1))
        return None

    def wait_for_change(self, timeout_s: float, count: int) -> None:
        """Wait until something has come or wake was called since `count`, or the time is over."""
        with self._changed:
            self._changed.wait_for(lambda: self.count != count, timeout_s)

    def wake(self) -> None:
        """Make all waiting threads check again."""
        with self._changed:
            self.count += 1
            self._changed.notify_all()

    def missing(self, topics: Collection[str]) -> list[str]:
        """Return those of `topics` on which nothing has been received yet."""
        self.poll()
        with self._changed:
            return [topic for topic in topics if self._topics[topic].received == -math.inf]

    def ages(self, topics: Collection[str], now: float) -> dict[str, float]:
        """
        Return the age of the last message of each topic, {topic: seconds}, infinity for none.

        :param now: monotonic time.
        """
        with self._changed:
            return {topic: now - self._topics[topic].received for topic in topics}


def reception_time(info: Mapping[str, Any]) -> float:
    """
    Return the monotonic time at which the middleware received a message.

    It may have waited in a queue since then, so a slow executor makes no message look fresh.

    :param info: what rclpy hands to a callback beside the message.
    """
    now = time.monotonic()
    received_ns = info.get('received_timestamp', 0)
    return now - max(0.0, (time.time_ns() - received_ns) / 1e9) if received_ns else now
