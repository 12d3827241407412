# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services that answer whatever happens, at once or later, and errors in the log."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
import threading
import traceback
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from tap_ros.base.errors import TapError
from tap_ros.base.text import escaped
from tap_ros.ros.subscriptions import PollOnlyGroup
from tap_ros.ros.topics import SERVICE_QOS

WAIT_NS = 5 * 10**7  # after which a thread looks whether its node ends, or has more to wait for


def log_error(node: Node, what: str, error: BaseException) -> None:
    """Log an error in one line; an unexpected one, that is no TapError, with its traceback."""
    if isinstance(error, TapError):
        node.get_logger().error(f'{what}: {escaped(error, 1000)}')
        return
    for line in ''.join(traceback.format_exception(error)).splitlines():
        node.get_logger().error(f'{what}: {escaped(line)}')


def reason(node: Node, what: str, error: Exception) -> str:
    """Return why something failed, for whoever asked for it; log what was not expected."""
    if isinstance(error, TapError):
        return str(error)
    log_error(node, what, error)
    return f'internal error: {type(error).__name__}: {escaped(error)}'


def answering(node: Node, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Wrap the callback of a service so that any exception becomes a refusal with its reason."""
    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            return type(response)(success=False, message=reason(node, 'service', error))

    return answer


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


class DeferredService:
    """
    A service whose requests are taken by a thread of its own, and answered by any thread.

    An executor looks at everything that its node has, three times for a request, and holds
    Python's lock meanwhile.

    :param take: called with each request and a function that sends its response; that function
        has to be called exactly once.
    """

    def __init__(self, node: Node, service_type: Any, name: str,
                 take: Callable[[Any, Callable[[Any], object]], object]) -> None:
        self._node, self._take = node, take
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

    def _run(self) -> None:
        while not self._ended.is_set() and self._node.context.ok():
            try:
                if wait_for_some(self._node.context, [self._service]):
                    self._take_one()
            except Exception as error:
                if self._node.context.ok():
                    log_error(self._node, self._service.srv_name, error)
                    self._ended.wait(1)  # whatever it is, it may last

    def _take_one(self) -> bool:
        """Take a request if one waits; return whether it did."""
        with self._service.handle:
            request, header = self._service.handle.service_take_request(
                self._service.srv_type.Request)  # type: ignore[attr-defined]
        if header is not None:
            self._take(request, lambda response: self._service.send_response(response, header))
        return header is not None
