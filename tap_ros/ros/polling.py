# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Requests, answers and messages that are taken without an executor.

An executor looks at everything that its node has, three times for a request or an answer, holding
Python's lock, and an answer comes to all clients of its service. While 30 pictures a second come,
an answer of predict_subgoal by executors takes 1 to 2 ms longer and half as much CPU time again,
and 16 clients get about half as many. So this file, and no other, uses what rclpy does not
promise: handles, and wait sets made of them. A recorder ends with what waits, by them, too.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
import threading
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from tap_ros.base.text import escaped
from tap_ros.ros.topics import SERVICE_QOS

WAIT_NS = 5 * 10**7  # after which a thread looks whether its node ends, or has more to wait for
TAKING_S = 0.5  # after which those that were taken are answered


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


def wait_for_some(context: Context, ones: Sequence[Any]) -> list[Any]:
    """
    Wait for WAIT_NS at most; return those that have something to take.

    :param ones: rclpy Services and Clients that no executor waits for.
    """
    clients = sum(isinstance(one, Client) for one in ones)
    with ExitStack() as held:
        for one in ones:
            held.enter_context(one.handle)
        wait_set = rclpy_implementation.WaitSet(
            0, 0, 0, clients, len(ones) - clients, 0, context.handle)
        wait_set.clear_entities()
        for one in ones:
            add = wait_set.add_client if isinstance(one, Client) else wait_set.add_service
            add(one.handle)
        wait_set.wait(WAIT_NS)
        ready = {*wait_set.get_ready_entities('service'), *wait_set.get_ready_entities('client')}
        return [one for one in ones if one.handle.pointer in ready]


def take_answers(node: Node, group: PollOnlyGroup) -> None:
    """Wait a moment for answers to the clients of a group, and hand them to those who asked."""
    clients = [one for one in node.clients if one.callback_group is group]
    if not clients:
        time.sleep(WAIT_NS / 1e9)
        return
    for client in wait_for_some(node.context, clients):
        header, answer = client.handle.take_response(client.srv_type.Response)
        if header is not None:
            with suppress(KeyError):  # given up
                client.get_pending_request(header.request_id.sequence_number).set_result(answer)


def take_messages(subscription: Subscription, limit: int) -> list[tuple[Any, dict[str, Any]]]:
    """Return messages, with their info, that wait for a callback; at most `limit`."""
    taken: list[tuple[Any, dict[str, Any]]] = []
    with (handle := subscription.handle):
        while len(taken) < limit and (
                one := handle.take_message(subscription.msg_type, subscription.raw)) is not None:
            taken.append(one)
    return taken


class DeferredService:
    """
    A service whose requests are taken by a thread of its own, and answered by any thread.

    :param take: called with each request and a function that sends its response; that function
        has to be called exactly once.
    :param work: called by the thread each time when it has taken what had come; returns whether
        there is more to do.
    """

    def __init__(self, node: Node, service_type: Any, name: str,
                 take: Callable[[Any, Callable[[Any], object]], object],
                 work: Callable[[], bool] = lambda: False) -> None:
        self._node, self._take, self._work = node, take, work
        self._service = node.create_service(
            service_type, name, lambda _, response: response, qos_profile=SERVICE_QOS,
            callback_group=PollOnlyGroup())
        self._ended = threading.Event()
        # No daemon: Python would abort if it ended while the thread is in C++.
        self._thread = threading.Thread(target=self._run, name=name)

    def start(self) -> None:
        """Begin to take requests, those that wait already among them."""
        self._thread.start()

    def close(self) -> None:
        """End the thread, and take what still waits."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        while self._take_one():
            pass

    def _send(self, response: Any, header: Any) -> None:
        try:
            self._service.send_response(response, header)
        except Exception as error:  # its client may have gone
            self._log(error)

    def _log(self, error: Exception) -> None:
        self._node.get_logger().error(
            f'{self._service.srv_name}: {type(error).__name__}: {escaped(error)}')

    def _run(self) -> None:
        context, more = self._node.context, False
        while not self._ended.is_set() and context.ok():
            try:
                if more or wait_for_some(context, [self._service]):
                    more = False  # should the work fail
                    try:
                        self._take_some()
                    finally:  # what was taken is answered, though another could not be
                        more = self._work()
            except Exception as error:
                if context.ok():
                    self._log(error)
                    self._ended.wait(1)  # whatever it is, it may last

    def _take_some(self) -> None:
        """Take what has come; what takes long to come waits for the next time."""
        deadline = time.monotonic() + TAKING_S
        while self._take_one() and time.monotonic() < deadline:
            pass

    def _take_one(self) -> bool:
        """Take a request if one waits; return whether it did."""
        with (handle := self._service.handle):
            request, header = handle.service_take_request(
                self._service.srv_type.Request)  # type: ignore[attr-defined]
        if header is not None:
            self._take(request, lambda response: self._send(response, header))
        return header is not None
