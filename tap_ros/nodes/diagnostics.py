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
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from tap_ros.nodes.subscriptions import why_silent
from tap_ros.text import escaped

PERIOD = 1.0  # s
RATE_SECONDS = 10.0  # over which rates are taken
WORK_SECONDS = 60.0  # over which percentiles are taken
ERROR_SECONDS = 10.0  # that the level is ERROR after an error
SILENT_SECONDS = 5.0  # of an input, after which a warning says why
LIMIT = 1000  # events of a kind that are remembered, the newest ones


class Record:
    """
    What is known of an input or of a kind of work; times of the monotonic clock, in s.

    :param seconds: how long an event counts as recent.
    :param max_age_s: of an input, see Diagnostics.
    :ivar count: of all events; newest: time of the last one.
    """

    def __init__(self, seconds: float, max_age_s: float = math.inf) -> None:
        self.max_age_s, self.count, self.newest = max_age_s, 0, -math.inf
        self._seconds = seconds
        self._events: deque[tuple[float, float]] = deque(maxlen=LIMIT)

    def add(self, now: float, value: float = 0.0) -> None:
        """Count an event."""
        self.newest = now
        self.count += 1
        self._events.append((now, value))

    def recent(self, now: float) -> np.ndarray:
        """Return time and value of recent events, float64 (N, 2), oldest first."""
        found = [event for event in self._events if now - event[0] <= self._seconds]
        return np.array(found).reshape(-1, 2)

    def rate(self, now: float) -> float:
        """Return the mean number of recent events per second; 0 for fewer than two."""
        times = self.recent(now)[:, 0]
        span = times[-1] - times[0] if len(times) else 0.0
        return (len(times) - 1) / span if span > 0 else 0.0

    def percentiles(self, now: float) -> np.ndarray:
        """Return the 50th and the 99th percentile of recent values; NaN without any."""
        values = self.recent(now)[:, 1]
        return np.percentile(values, (50, 99)) if len(values) else np.full(2, np.nan)


class Diagnostics:
    """
    Publishes the state of a node's work and inputs; its methods may be called from any thread.

    An input that falls silent, or never comes, is named in the log with the reason and the remedy.

    Status of the work: ERROR for ERROR_SECONDS after an error, else WARN with the reason while
    `idle` returns one, else OK.
    Of each input: NotReceived (WARN), Stale (STALE) when its newest message is older than its
    `max_age_s`, or OK.

    :param node: rclpy Node.
    :param inputs: {topic: max_age_s}; names as the node subscribes to them; math.inf for topics
        on which nothing may come for long.
    :param queue: called without arguments, returns how many requests wait; None for no queue.
    :param idle: called without arguments, returns why the node does not work, '' if it does.
    :param expected: inputs on which something has to come, though nothing may come for long.
    """

    def __init__(self, node: Node, inputs: Mapping[str, float],
                 queue: Callable[[], int] | None = None,
                 idle: Callable[[], str] = lambda: '', expected: Iterable[str] = ()) -> None:
        self._node, self._begun = node, time.monotonic()
        self._queue, self._idle = queue, idle
        self._lock = threading.Lock()
        self._inputs = {node.resolve_topic_name(topic): Record(RATE_SECONDS, max_age_s)
                        for topic, max_age_s in inputs.items()}
        self._expected = {node.resolve_topic_name(topic) for topic in expected}
        self._told: set[str] = set()  # topics whose silence has been logged
        self._work: dict[str, Record] = {}
        self._errors, self._last_error, self._error_time = 0, '', -math.inf
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Its own group: it goes on while the node works, where there are threads enough.
        node.create_timer(PERIOD, self._publish, MutuallyExclusiveCallbackGroup(),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def received(self, topic: str) -> None:
        """Count a message of one of the inputs."""
        with self._lock:
            self._inputs[self._node.resolve_topic_name(topic)].add(time.monotonic())

    def took(self, ms: float, what: str) -> None:
        """Add the milliseconds of a piece of work of this kind, such as 'predict_subgoal'."""
        with self._lock:
            self._work.setdefault(what, Record(WORK_SECONDS)).add(time.monotonic(), ms)

    def error(self, text: object) -> None:
        """Report an error, or its text; shown in one line."""
        with self._lock:
            self._errors += 1
            self._last_error, self._error_time = escaped(text), time.monotonic()

    def _publish(self) -> None:
        queue = None if self._queue is None else self._queue()  # it may take locks of its own
        now = time.monotonic()
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        with self._lock:
            message.status.append(self._describe_work(queue, now))
            for topic, source in self._inputs.items():
                message.status.append(self._describe_input(topic, source, now))
        self._publisher.publish(message)
        if not self._idle():
            self._tell_silence(now)

    def _tell_silence(self, now: float) -> None:
        """Warn, once for each silence, of inputs on which something should come."""
        silent = {topic for topic, source in self._inputs.items()
                  if now - max(source.newest, self._begun) > SILENT_SECONDS and (
                      source.max_age_s < math.inf or not source.count and topic in self._expected)}
        types: dict[str, Any] = {
            one.topic_name: one.msg_type for one in list(self._node.subscriptions)}
        for topic in sorted(silent - self._told):
            why = why_silent(self._node, topic, types.get(topic))
            self._node.get_logger().warning(
                f'nothing has come on {escaped(topic)} for {SILENT_SECONDS:g} s'
                + (f': {why}' if why else ', though it is published'))
        self._told = silent

    def _describe_work(self, queue: int | None, now: float) -> DiagnosticStatus:
        values: dict[str, int | str] = {} if queue is None else {'queue': queue}
        for what, work in self._work.items():
            p50, p99 = work.percentiles(now)
            values |= {f'{what} calls': work.count,
                       f'{what} p50_ms': f'{p50:.2f}', f'{what} p99_ms': f'{p99:.2f}'}
        values['errors'] = self._errors
        if self._errors:
            age = now - self._error_time
            values |= {'last_error': self._last_error, 'last_error_age_s': f'{age:.1f}'}
            if age < ERROR_SECONDS:
                return self._status(
                    'service', DiagnosticStatus.ERROR, self._last_error, values)
        idle = self._idle()
        if idle:
            return self._status('service', DiagnosticStatus.WARN, idle, values)
        return self._status('service', DiagnosticStatus.OK, 'OK', values)

    def _describe_input(self, topic: str, source: Record, now: float) -> DiagnosticStatus:
        age = now - source.newest
        if not source.count:
            level, status, age = DiagnosticStatus.WARN, 'NotReceived', math.nan
        elif age > source.max_age_s:
            level, status = DiagnosticStatus.STALE, 'Stale'
        else:
            level, status = DiagnosticStatus.OK, 'OK'
        return self._status(topic, level, status, {
            'status': status, 'age_s': f'{age:.3f}', 'max_age_s': f'{source.max_age_s:g}',
            'rate_hz': f'{source.rate(now):.2f}', 'count': source.count})

    def _status(self, name: str, level: bytes, text: str,
                values: Mapping[str, Any]) -> DiagnosticStatus:
        return DiagnosticStatus(
            name=f'{self._node.get_name()}: {name}', level=level, message=text,
            hardware_id=self._node.get_fully_qualified_name(),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
