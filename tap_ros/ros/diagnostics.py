# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The state of a node, once a second on /diagnostics, where rqt and Foxglove read it."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
import math
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tap_msgs.msg import ObjectStates
from tap_ros.base.text import escaped
from tap_ros.ros.subscriptions import publishers_of, rivals, steady_timer, why_silent

PERIOD = 1.0  # s
STALE_S = 2.0  # s without a message after which a stream is stale
RATE_SECONDS = 10.0  # over which rates are taken
WORK_SECONDS = 60.0  # over which percentiles are taken
ERROR_SECONDS = 10.0  # that the level is ERROR after an error
SILENT_SECONDS = 5.0  # of an input, after which a warning says why
CAMERA_TYPES = (Image, CompressedImage, CameraInfo)  # of which a topic has one publisher
LIMIT = 1000  # events of a kind that are remembered, the newest ones


class Record:
    """
    Events of an input or of a kind of work; times of the monotonic clock, in s.

    :ivar count: of all events; newest: time of the last one.
    """

    def __init__(self) -> None:
        self.count, self.newest = 0, -math.inf
        self._events: deque[tuple[float, float]] = deque(maxlen=LIMIT)

    def add(self, now: float, value: float = 0.0) -> None:
        """Count an event."""
        self.count, self.newest = self.count + 1, now
        self._events.append((now, value))

    def recent(self, now: float, seconds: float) -> np.ndarray:
        """Return time and value of the events of so many seconds, float64 (N, 2)."""
        found = [event for event in self._events if now - event[0] <= seconds]
        return np.array(found).reshape(-1, 2)

    def rate(self, now: float) -> float:
        """Return the mean number of recent events per second; 0 for fewer than two."""
        times = self.recent(now, RATE_SECONDS)[:, 0]
        span = times[-1] - times[0] if len(times) else 0.0
        return (len(times) - 1) / span if span > 0 else 0.0


class Diagnostics:
    """
    Publishes the state of a node's work and inputs; its methods may be called from any thread.

    An input that falls silent, or never comes, is named in the log with the reason and the remedy;
    so are cameras that publish on one topic. Objects may be silent while somebody publishes them:
    a tracker waits for its selection.

    Status of the work: ERROR for ERROR_SECONDS after an error, else WARN with the reason while
    `idle` returns one, else OK.
    Of each input: NotReceived (WARN for what has to come, else OK), Stale (STALE) when a stream is
    older than STALE_S, or OK.

    :param node: rclpy Node.
    :param streams: topics that come all the time, named as the node subscribes to them.
    :param others: inputs on which nothing may come for long.
    :param queue: called without arguments, returns how many requests wait; None for no queue.
    :param idle: called without arguments, returns why the node does not work, '' if it does.
    :param expected: those of `others` on which something has to come.
    """

    def __init__(self, node: Node, streams: Iterable[str], others: Iterable[str] = (),
                 queue: Callable[[], int] | None = None,
                 idle: Callable[[], str] = lambda: '', expected: Iterable[str] = ()) -> None:
        self._node, self._begun = node, math.inf  # until the node is spun: before, it is deaf
        self._queue, self._idle = queue, idle
        self._lock = threading.Lock()
        self._max_age_s = {node.resolve_topic_name(topic): age for topics, age in (
            (streams, STALE_S), (others, math.inf)) for topic in topics}
        self._inputs = {topic: Record() for topic in self._max_age_s}
        self._expected = {node.resolve_topic_name(topic) for topic in expected}
        self._silent: set[str] = set()  # topics on which nothing had come when last looked at
        self._told: set[str] = set()  # those of them that have been logged
        self._shared: set[str] = set()  # topics of which it has been logged that several publish
        self._work: dict[str, Record] = {}
        self._errors, self._last_error, self._error_time = 0, '', -math.inf
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Its own group: it goes on while the node works, where there are threads enough.
        steady_timer(node, PERIOD, self._publish, MutuallyExclusiveCallbackGroup())

    def received(self, topic: str) -> None:
        """Count a message of one of the inputs."""
        with self._lock:
            self._inputs[self._node.resolve_topic_name(topic)].add(time.monotonic())

    def took(self, ms: float, what: str) -> None:
        """Add the milliseconds of a piece of work of this kind, such as 'predict_subgoal'."""
        with self._lock:
            self._work.setdefault(what, Record()).add(time.monotonic(), ms)

    def error(self, text: object) -> None:
        """Report an error, or its text; shown in one line."""
        with self._lock:
            self._errors += 1
            self._last_error, self._error_time = escaped(text), time.monotonic()

    def _publish(self) -> None:
        queue = {} if self._queue is None else {'queue': self._queue()}  # it may take locks
        now, idle = time.monotonic(), self._idle()
        self._begun = min(self._begun, now)
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        with self._lock:
            message.status.append(self._describe_work(queue, now, idle))
            for topic, source in self._inputs.items():
                message.status.append(self._describe_input(topic, source, now))
        self._publisher.publish(message)
        self._log_silence(now)

    def _log_silence(self, now: float) -> None:
        """Warn, once each time, of inputs that are silent, and of cameras that share a topic."""
        silent = {topic for topic, source in self._inputs.items()
                  if now - max(source.newest, self._begun) > SILENT_SECONDS and (
                      self._max_age_s[topic] < math.inf
                      or not source.count and topic in self._expected)}
        types: dict[str, Any] = {
            one.topic_name: one.msg_type for one in list(self._node.subscriptions)}
        cameras = {topic: found for topic, age in self._max_age_s.items()
                   if age < math.inf and types.get(topic) in CAMERA_TYPES
                   and (found := rivals(publishers_of(self._node, topic)))}
        for topic in sorted(cameras.keys() - self._shared):
            self._node.get_logger().warning(f'{escaped(cameras[topic])}; leave one of them')
        self._shared = {*cameras}
        # Twice: what waited while a busy machine kept this node from listening is taken by then.
        silent, self._silent = silent & self._silent, silent
        for topic in sorted(silent - self._told):
            why = why_silent(self._node, topic, types.get(topic))
            if not why and types.get(topic) is ObjectStates:
                silent.remove(topic)  # and told when they are no longer published
                continue
            self._node.get_logger().warning(
                f'nothing has come on {escaped(topic)} for {SILENT_SECONDS:g} s'
                + (f': {why}' if why else ', though it is published'))
        self._told = silent

    def _describe_work(self, values: dict[str, Any], now: float, idle: str) -> DiagnosticStatus:
        for what, work in self._work.items():
            times = work.recent(now, WORK_SECONDS)[:, 1]
            p50, p99 = np.percentile(times, (50, 99)) if len(times) else (math.nan, math.nan)
            values |= {f'{what} calls': work.count,
                       f'{what} p50_ms': f'{p50:.2f}', f'{what} p99_ms': f'{p99:.2f}'}
        level, text = (DiagnosticStatus.WARN, idle) if idle else (DiagnosticStatus.OK, 'OK')
        values['errors'] = self._errors
        if self._errors:
            age = now - self._error_time
            values |= {'last_error': self._last_error, 'last_error_age_s': f'{age:.1f}'}
            if age < ERROR_SECONDS:
                level, text = DiagnosticStatus.ERROR, self._last_error
        return self._status('service', level, text, values)

    def _describe_input(self, topic: str, source: Record, now: float) -> DiagnosticStatus:
        age, max_age_s = now - source.newest, self._max_age_s[topic]
        level, text = DiagnosticStatus.OK, 'OK'
        if not source.count:
            text, age = 'NotReceived', math.nan
            if max_age_s < math.inf or topic in self._expected:
                level = DiagnosticStatus.WARN
        elif age > max_age_s:
            level, text = DiagnosticStatus.STALE, 'Stale'
        return self._status(topic, level, text, {
            'status': text, 'age_s': f'{age:.3f}', 'max_age_s': f'{max_age_s:g}',
            'rate_hz': f'{source.rate(now):.2f}', 'count': source.count})

    def _status(self, name: str, level: bytes, text: str,
                values: Mapping[str, Any]) -> DiagnosticStatus:
        return DiagnosticStatus(
            name=f'{self._node.get_fully_qualified_name()[1:]}: {name}', level=level, message=text,
            hardware_id=self._node.get_fully_qualified_name(),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
