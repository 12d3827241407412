# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The state of a node, once a second on /diagnostics, where rqt and Foxglove read it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
import threading
import time
from typing import Any, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from tap_ros.text import escaped

if TYPE_CHECKING:
    from rclpy.node import Node

PERIOD = 1.0  # s
RATE_SECONDS = 10.0  # over which rates are taken, of RATE_LIMIT messages at most
RATE_LIMIT = 100
WORK_SECONDS = 60.0  # over which percentiles are taken, of WORK_LIMIT durations at most
WORK_LIMIT = 10_000
ERROR_SECONDS = 10.0  # that the level is ERROR after an error


class RollingWindow:
    """
    Numbers with the times at which they were added; old ones are forgotten.

    :param seconds: how long a number counts.
    :param limit: most numbers kept, the newest ones; bounds the memory whatever their rate.
    """

    def __init__(self, seconds: float, limit: int) -> None:
        self._seconds = seconds
        self._times, self._values = np.empty(limit), np.empty(limit)  # rings: fast to summarise
        self._count = 0

    def add(self, now: float, value: float = 0.0) -> None:
        """Add a number at time `now`, in seconds of a monotonic clock."""
        place = self._count % len(self._times)
        self._times[place], self._values[place] = now, value
        self._count += 1

    def newest(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Return times and values, each float64 (N,), oldest first."""
        limit = len(self._times)
        places = np.arange(max(self._count - limit, 0), self._count) % limit
        places = places[np.searchsorted(self._times[places], now - self._seconds):]
        return self._times[places], self._values[places]


def rate(times: np.ndarray) -> float:
    """
    Return the mean number of events per second; 0 for fewer than two.

    :param times: (N,) seconds, oldest first.
    """
    span = times[-1] - times[0] if len(times) else 0.0
    return (len(times) - 1) / span if span > 0 else 0.0


def percentiles(values: np.ndarray) -> np.ndarray:
    """Return the 50th and the 99th percentile; NaN without values."""
    return np.percentile(values, (50, 99)) if len(values) else np.full(2, np.nan)


@dataclass
class _Record:
    """What is known of an input or of a kind of work; times of the monotonic clock, in s."""

    recent: RollingWindow
    max_age_s: float = math.inf
    count: int = 0
    newest: float = -math.inf

    def add(self, value: float = 0.0) -> None:
        """Count an event of now."""
        self.newest = time.monotonic()
        self.count += 1
        self.recent.add(self.newest, value)


class Diagnostics:
    """
    Publishes the state of a node's work and inputs; its methods may be called from any thread.

    Of the work: ERROR for some seconds after an error, else WARN while `idle` says why, else OK.
    Of each input: NotReceived (WARN), Stale (STALE) when its newest message is older than its
    `max_age_s`, or OK.

    :param node: rclpy Node.
    :param inputs: {topic: max_age_s}; names as the node subscribes to them; math.inf for topics
        on which nothing may come for long.
    :param queue: called without arguments, returns how many requests wait; None for no queue.
    :param idle: called without arguments, returns why the node does not work, '' if it does.
    """

    def __init__(self, node: 'Node', inputs: Mapping[str, float],
                 queue: Callable[[], int] | None = None,
                 idle: Callable[[], str] = lambda: '') -> None:
        self._node = node
        self._queue, self._idle = queue, idle
        self._lock = threading.Lock()
        self._inputs = {
            node.resolve_topic_name(topic): _Record(
                RollingWindow(RATE_SECONDS, RATE_LIMIT), max_age_s)
            for topic, max_age_s in inputs.items()}
        self._by_name = self._inputs | {
            topic: self._inputs[node.resolve_topic_name(topic)] for topic in inputs}
        self._work: dict[str, _Record] = {}  # what -> Work
        self._errors, self._last_error, self._error_time = 0, '', -math.inf
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Its own group: it goes on while the node works, where there are threads enough.
        node.create_timer(PERIOD, self._publish, MutuallyExclusiveCallbackGroup(),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def received(self, topic: str) -> None:
        """
        Count a message.

        :param topic: one of the inputs, by the name given or by the resolved one.
        """
        with self._lock:
            self._by_name[topic].add()

    def took(self, ms: float, what: str) -> None:
        """
        Add the duration of a piece of work.

        :param ms: milliseconds.
        :param what: name of this kind of work, for example 'predict_subgoal'.
        """
        with self._lock:
            if what not in self._work:
                self._work[what] = _Record(RollingWindow(WORK_SECONDS, WORK_LIMIT))
            self._work[what].add(ms)

    def error(self, text: object) -> None:
        """
        Report an error.

        :param text: the error or its text; shown in one line.
        """
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

    def _describe_work(self, queue: int | None, now: float) -> DiagnosticStatus:
        values: dict[str, int | str] = {} if queue is None else {'queue': queue}
        for what, work in self._work.items():
            p50, p99 = percentiles(work.recent.newest(now)[1])
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

    def _describe_input(self, topic: str, source: _Record, now: float) -> DiagnosticStatus:
        age = now - source.newest
        if not source.count:
            level, status, age = DiagnosticStatus.WARN, 'NotReceived', math.nan
        elif age > source.max_age_s:
            level, status = DiagnosticStatus.STALE, 'Stale'
        else:
            level, status = DiagnosticStatus.OK, 'OK'
        return self._status(topic, level, status, {
            'status': status, 'age_s': f'{age:.3f}', 'max_age_s': f'{source.max_age_s:g}',
            'rate_hz': f'{rate(source.recent.newest(now)[0]):.2f}', 'count': source.count})

    def _status(self, name: str, level: bytes, text: str,
                values: Mapping[str, Any]) -> DiagnosticStatus:
        return DiagnosticStatus(
            name=f'{self._node.get_name()}: {name}', level=level, message=text,
            hardware_id=self._node.get_fully_qualified_name(),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
