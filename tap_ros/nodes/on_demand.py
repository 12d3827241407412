# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Observations that are taken only when somebody asks for them."""

from collections.abc import Callable, Collection, Mapping
import math
import threading
import time
from typing import Any, TYPE_CHECKING

from rclpy.callback_groups import CallbackGroup
from tap_ros.nodes.observations import Observations, reception_time
from tap_ros.nodes.subscriptions import Heard, LOOK_PERIOD, named_with_reason

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.qos import QoSProfile

MOST = 100  # messages of a topic that are taken at once; more come with the next question
PAUSE = 0.005  # s between two looks while waiting


class Unwatched(CallbackGroup):
    """Subscriptions of this group wake no executor; their messages wait to be taken."""

    def can_execute(self, entity: Any) -> bool:
        """Tell that no callback is ever due."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Refuse to begin a callback."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing: none has begun."""


class PulledObservations:
    """
    Observations of topics that stream in and are seldom asked for.

    With a callback for each message, every one would stop a network at work for a while.

    :param node: rclpy Node.
    :param types: {short name: (message type, topic name)}, the one whose stamp counts first.
    :param qos: QoSProfile of all of them; its depth is how many messages wait to be taken.
    :param latched: as in Observations.
    :param on_message: called with the topic name for each message that is taken, or None.
    """

    def __init__(self, node: 'Node', types: Mapping[str, tuple[type, str]], qos: 'QoSProfile',
                 latched: bool = False, on_message: Callable[[str], object] | None = None) -> None:
        self._taking = threading.Lock()
        self._observations = Observations(*types, latched=latched)
        self._on_message = on_message
        self._names = {topic: name for topic, (_, name) in types.items()}
        group = Unwatched()
        self._heard = {
            topic: Heard(node, message_type, name, lambda message: None, qos, group)
            for topic, (message_type, name) in types.items()}
        self._looked = -math.inf  # monotonic time of the last look at what is offered

    def newest(self, *topics: str) -> dict[str, Any] | None:
        """Return the newest {topic: message} that has all of `topics`; None if there is none."""
        self.pull()
        return self._observations.newest(*topics)

    def wait(self, topics: Collection[str], timeout_s: float,
             after_ns: int) -> dict[str, Any] | None:
        """
        Wait for an observation.

        :param topics: what it must have.
        :param timeout_s: most seconds to wait.
        :param after_ns: only what is stamped later than this.
        :return: {topic: message}, or None when none came in time.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            self.pull()
            found = self._observations.newest(*topics, after_ns=after_ns)
            if found is not None or time.monotonic() >= deadline:
                return found
            time.sleep(PAUSE)

    @property
    def jumps(self) -> int:
        """How often the clock of the stamps has jumped."""
        return self._observations.jumps

    def missing(self, topics: Collection[str]) -> list[str]:
        """Return those of `topics` of which nothing has come since the start."""
        self.pull()
        return self._observations.missing(topics)

    def explained(self, topic: str, name: str) -> str:
        """Return the name of a topic, and why nothing comes on it where that is known."""
        return named_with_reason(self._heard.get(topic), name)

    def pull(self) -> None:
        """Take what has come, all topics together in the order in which it came."""
        with self._taking:
            come = []
            for topic, heard in self._heard.items():
                subscription = heard.subscription
                with subscription.handle:
                    for _ in range(MOST):
                        taken = subscription.handle.take_message(subscription.msg_type, False)
                        if taken is None:
                            break
                        come.append((reception_time(taken[1]), topic, taken[0],
                                     taken[1].get('source_timestamp', 0)))
            if time.monotonic() - self._looked > LOOK_PERIOD:
                self._looked = time.monotonic()
                for heard in self._heard.values():  # when what has waited is taken
                    heard.look_after()
            for received, topic, message, sent_ns in sorted(come, key=lambda one: one[0]):
                self._observations.put(topic, message, received, sent_ns)
                if self._on_message is not None:
                    self._on_message(self._names[topic])
