# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of several topics, grouped by their stamp, with the time of their reception."""

from collections import deque, OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
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
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.ros.subscriptions import (
    ADAPT_PERIOD,
    adapt_regularly,
    AdaptiveSubscription,
    PollOnlyGroup,
)

DEPTH = 10  # stamps remembered
JUMP_NS = 10 * 10**9  # a stamp that far ahead of all others is not believed at once
REMEMBERED = 100  # messages of a latched topic by which repetitions are recognised
PROOF = 3  # messages in a row that prove that the clock of a topic has jumped
POLL_LIMIT = 100  # messages of a topic taken by one poll; the rest comes with the next
POLL_PERIOD = 0.005  # s between two polls while waiting
CLOCK_S = 1.0  # s after which nothing is known of a clock or driver that is silent


@dataclass(frozen=True)
class Moment:
    """Messages of one stamp."""

    stamp_ns: int
    messages: dict[str, Any]  # topic -> message
    received: float  # s, monotonic: when the one that was received first came


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
        self._topics, self._latched = topics, latched
        self._changed = threading.Condition()  # reentrant
        # stamp in ns -> {topic: (message, received)}
        self._by_stamp: OrderedDict[int, dict[str, tuple[Any, float]]] = OrderedDict()
        self._newest: dict[str, int] = {}  # topic -> stamp in ns
        self._previous: dict[str, int] = {}  # topic -> the stamp before that
        self._received: dict[str, float] = {}  # topic -> monotonic time of its last message
        self._repeated: dict[str, float] = {}  # topic -> when a stamp came again
        # topic -> stamps in a row that are not believed
        self._suspects: dict[str, list[int]] = {topic: [] for topic in topics}
        self._sent: dict[str, deque[int]] = {topic: deque(maxlen=REMEMBERED) for topic in topics}
        self._clock = -1, -math.inf, False  # ns, when it came, whether it said the same before
        self.count, self.jumps = 0, 0
        self._subscriptions: dict[str, AdaptiveSubscription] = {}
        self._poll: Callable[[], None] | None = None

    def subscribe(self, node: Node, types: Mapping[str, tuple[type, str]], qos: QoSProfile,
                  callback_group: CallbackGroup | None = None,
                  on_message: Callable[[str], object] = lambda name: None,
                  others: Mapping[str, Callable[..., Any]] = MappingProxyType({}),
                  on_demand: bool = False) -> None:
        """
        Subscribe to the topics; latched pictures may come on NAME/compressed, too.

        :param types: {short name: (message type, topic name)}.
        :param qos: QoSProfile of all of them.
        :param callback_group: callback group, None for the node's own.
        :param on_message: called with the topic name after each message.
        :param others: {short name: callback that takes message and info instead of `put`}.
        :param on_demand: messages are taken only when something is asked of this object, as many
            as `qos` keeps: a callback for each would interrupt a running network.
        """
        def put(topic: str, message: Any, info: dict[str, Any]) -> None:
            self.put(topic, message, reception_time(info), info.get('source_timestamp', 0))
            on_message(types[topic][1])

        group = PollOnlyGroup() if on_demand else callback_group
        made: list[tuple[str, AdaptiveSubscription]] = []
        for topic, (message_type, name) in types.items():
            def subscribe(kind: type, name: str, topic: str = topic) -> AdaptiveSubscription:
                made.append((topic, AdaptiveSubscription(
                    node, kind, name, others.get(topic, partial(put, topic)), qos, group)))
                return made[-1][1]

            self._subscriptions[topic] = subscribe(message_type, name)
            if self._latched and topic == 'image':
                subscribe(CompressedImage, f'{name}/compressed')
        if not (self._latched or on_demand):
            node.create_subscription(
                Clock, 'clock', self.on_clock, qos_profile_sensor_data, callback_group=group)
        if not on_demand:
            adapt_regularly(node, [one for _, one in made], callback_group)
            return
        adapted = [-math.inf]  # monotonic time

        def poll() -> None:
            with self._changed:  # all topics together, in the order of reception
                taken = sorted(((reception_time(info), topic, message, info)
                                for topic, subscription in made
                                for message, info in subscription.take(POLL_LIMIT)),
                               key=lambda one: one[0])
                if time.monotonic() - adapted[0] > ADAPT_PERIOD:
                    adapted[0] = time.monotonic()
                    for _, subscription in made:  # nothing waits in it now
                        subscription.adapt()
                for _, topic, message, info in taken:
                    put(topic, message, info)

        self._poll = poll

    def poll(self) -> None:
        """Take what has arrived, if that is done on demand alone."""
        if self._poll is not None:
            self._poll()

    def names(self, topics: Iterable[str], explained: bool = False) -> str:
        """Return the full names of topics; explained: with why nothing arrives, where known."""
        words = []
        for topic in topics:
            subscription = self._subscriptions[topic]
            why = subscription.why_silent() if explained else ''
            if explained and time.monotonic() - self._repeated.get(topic, -math.inf) < CLOCK_S:
                why = 'its messages repeat one stamp'
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
        stamp = to_nanoseconds(message.header.stamp)
        received = time.monotonic() if received is None else received
        with self._changed:
            if not self._latched and not self._believe(topic, stamp):
                return
            if self._latched and sent_ns:
                if sent_ns in self._sent[topic]:
                    return
                self._sent[topic].append(sent_ns)
            if stamp != self._newest.get(topic):
                self._previous[topic] = self._newest.get(topic, stamp)
            elif not self._latched and not self.time_stands:
                received, self._repeated[topic] = self._received[topic], received
            self._newest[topic], self._received[topic] = stamp, received
            self._by_stamp.setdefault(stamp, {})[topic] = message, received
            self._by_stamp.move_to_end(stamp)
            while len(self._by_stamp) > DEPTH * len(self._topics):
                self._by_stamp.popitem(last=False)
            self.wake()

    def attach(self, topic: str, stamp: int, message: Any, received: float) -> None:
        """
        Add a derived message for a known stamp; the age of its topic does not change.

        :param received: monotonic time at which what it was derived from was received.
        """
        with self._changed:
            parts = self._by_stamp.get(stamp)
            if parts is not None:
                parts[topic] = message, received
                self.wake()

    def note(self, topic: str, received: float) -> None:
        """Note the reception of something from which messages of a topic are derived."""
        with self._changed:
            self._received[topic] = received

    def on_clock(self, message: Clock) -> None:
        """Take a message of /clock."""
        now_ns = to_nanoseconds(message.clock)
        self._clock = now_ns, time.monotonic(), now_ns == self._clock[0]

    @property
    def time_stands(self) -> bool:
        """Return whether the last two messages of /clock, the newest of them recent, are equal."""
        _, received, same = self._clock
        return same and time.monotonic() - received < CLOCK_S

    def without(self, topic: str, other: str) -> list[int]:
        """Return the stamps at which `other` has come and `topic` has not, newest last."""
        with self._changed:
            return sorted(stamp for stamp, parts in self._by_stamp.items()
                          if other in parts and topic not in parts)

    def _believe(self, topic: str, stamp: int) -> bool:
        """Return whether a stamp is used; forget all others when the clock has jumped to it."""
        self._drop_stray(topic, stamp)
        clock = max(self._newest.values(), default=stamp)
        if self._newest.get(topic, 0) <= stamp <= clock + JUMP_NS:
            self._suspects[topic].clear()
            return True
        suspects = self._suspects[topic]
        if suspects and not 0 <= stamp - suspects[-1] <= JUMP_NS:
            suspects.clear()  # a stray of its own
        suspects.append(stamp)
        if len(suspects) < PROOF:
            return False
        self.jumps += 1
        self._by_stamp.clear()
        self._newest.clear()
        self._previous.clear()
        for others in self._suspects.values():
            others.clear()
        return True

    def _drop_stray(self, topic: str, stamp: int) -> None:
        """Forget the newest message of a topic when this stamp goes on from the one before it."""
        newest, previous = self._newest.get(topic), self._previous.get(topic)
        if newest is not None and previous is not None and previous <= stamp < newest:
            self._newest[topic] = previous
            self._by_stamp.get(newest, {}).pop(topic, None)

    def newest(self, *topics: str, after_ns: int = -1,
               since: float = -math.inf) -> Moment | None:
        """
        Return the newest Moment that has all of `topics`; None if there is none.

        :param after_ns: only what is stamped later than this.
        :param since: only what was received at or after this monotonic time.
        """
        self.poll()
        with self._changed:
            found = [stamp for stamp, parts in self._by_stamp.items() if stamp > after_ns and all(
                topic in parts and parts[topic][1] >= since for topic in topics)]
            if not found:
                return None
            stamp = found[-1] if self._latched else max(found)
            parts = self._by_stamp[stamp]
            return Moment(stamp, {topic: message for topic, (message, _) in parts.items()},
                          min(parts[topic][1] for topic in topics))

    def wait(self, topics: Collection[str], timeout_s: float, after_ns: int = -1,
             give_up: Callable[[], bool] = lambda: False) -> Moment | None:
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
                self._changed.wait(min(left, 0.1 if self._poll is None else POLL_PERIOD))
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
            return [topic for topic in topics if topic not in self._received]

    def ages(self, topics: Collection[str], now: float) -> dict[str, float]:
        """
        Return the age of the last message of each topic, {topic: seconds}, infinity for none.

        :param now: monotonic time.
        """
        with self._changed:
            return {topic: now - self._received.get(topic, -math.inf) for topic in topics}


def reception_time(info: Mapping[str, Any]) -> float:
    """
    Return the monotonic time at which the middleware received a message.

    It may have waited in a queue since then, so a slow executor makes no message look fresh.

    :param info: what rclpy hands to a callback beside the message.
    """
    now = time.monotonic()
    received_ns = info.get('received_timestamp', 0)
    return now - max(0.0, (time.time_ns() - received_ns) / 1e9) if received_ns else now
