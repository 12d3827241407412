# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of several topics put together by their stamp."""

from collections import OrderedDict
import threading
import time

from tap_ros.nodes.topics import to_nanoseconds

DEPTH = 10  # stamps remembered


class Observations:
    """
    Collect messages that carry the same stamp; safe to use from several threads.

    :param topics: short names, for example 'image', 'objects'; the first is the one whose stamp
        counts, the others describe it.
    """

    def __init__(self, *topics):
        self._topics = topics
        self._changed = threading.Condition()
        self._by_stamp = OrderedDict()  # stamp in ns -> {topic: message}, oldest first
        self._newest = dict.fromkeys(topics, 0)  # stamp in ns
        self._seen = set()

    def subscribe(self, node, types, qos, callback_group=None):
        """
        Subscribe to the topics.

        :param node: rclpy Node.
        :param types: {short name: (message type, topic name)}.
        :param qos: QoSProfile of all of them.
        :param callback_group: callback group, None for the node's own.
        """
        for topic, (message_type, name) in types.items():
            node.create_subscription(
                message_type, name, lambda message, topic=topic: self.put(topic, message), qos,
                callback_group=callback_group)

    def put(self, topic, message):
        """Add a message with a header."""
        stamp = to_nanoseconds(message.header.stamp)
        with self._changed:
            if stamp < self._newest[topic]:  # time went back: another simulator, a looping bag
                self._by_stamp.clear()
                self._newest = dict.fromkeys(self._topics, 0)
            self._newest[topic] = stamp
            self._seen.add(topic)
            self._by_stamp.setdefault(stamp, {})[topic] = message
            while len(self._by_stamp) > DEPTH * len(self._topics):
                self._by_stamp.popitem(last=False)
            self._changed.notify_all()

    def newest(self, *topics, after_ns=-1):
        """
        Return the newest {topic: message} that has all of `topics`; None if there is none.

        :param after_ns: only what is stamped later than this.
        """
        with self._changed:
            stamps = [stamp for stamp, found in self._by_stamp.items()
                      if stamp > after_ns and all(topic in found for topic in topics)]
            return dict(self._by_stamp[max(stamps)]) if stamps else None

    def wait(self, topics, timeout_s, after_ns=-1, give_up=lambda: False):
        """
        Wait for an observation.

        :param topics: what it must have.
        :param timeout_s: most seconds to wait.
        :param after_ns: only what is stamped later than this.
        :param give_up: asked at every change and ten times a second whether to stop waiting.
        :return: {topic: message}, or None when none came in time.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not give_up():
                found = self.newest(*topics, after_ns=after_ns)
                left = deadline - time.monotonic()
                if found is not None or left <= 0:
                    return found
                self._changed.wait(min(left, 0.1))
        return None

    def wake(self):
        """Make all that wait ask give_up again."""
        with self._changed:
            self._changed.notify_all()

    def missing(self, topics):
        """Return those of `topics` of which nothing has come since the start."""
        with self._changed:
            return [topic for topic in topics if topic not in self._seen]
