# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calls with a time-out, services that answer whatever happens, and nodes that are spun."""

from collections.abc import Callable
import threading
import time
import traceback
from typing import Any, Self

from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from tap_ros.base.errors import TapError
from tap_ros.base.text import escaped
from tap_ros.ros.heartbeat import Liveness
from tap_ros.ros.polling import PollOnlyGroup, take_answers

POLL_S = 0.05  # between two looks at whether a server is still there


class CallError(TapError):
    """A service, action or topic did not answer in time, or refused."""


class NotYet(CallError):
    """A service refused what it may do later: ask again."""


def countdown(what: str, seconds: float) -> Callable[[], float]:
    """Return a function that tells how many seconds are left; CallError once there are none."""
    deadline = time.monotonic() + seconds

    def left() -> float:
        if (found := deadline - time.monotonic()) <= 0:
            raise CallError(f'{what}: not done within {seconds:g} s')
        return round(found, 2) or found  # as errors print it
    return left


def log_error(node: Node, what: str, error: BaseException) -> None:
    """Log an error in one line; an unexpected one, that is no TapError, with its traceback."""
    lines = [escaped(error, 1000)] if isinstance(error, TapError) else [
        escaped(line) for line in ''.join(traceback.format_exception(error)).splitlines()]
    for line in lines:
        node.get_logger().error(f'{what}: {line}')


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


def spin_once(executor: Executor, node: Node) -> None:
    """Run what is ready, within 0.1 s; a callback that raises is logged, and ends no node."""
    try:
        executor.spin_once(timeout_sec=0.1)
    except ExternalShutdownException:
        raise
    except InvalidHandle:  # of what another thread destroyed just now
        pass
    except Exception as error:
        log_error(node, 'a callback failed; the node goes on', error)


class Spinner:
    """
    Spin a node in the background, for as long as the with-block lasts.

    A thread that keeps spinning answers ten times faster than spinning once per call.

    :param node: rclpy Node; destroying it stays with the caller.
    :ivar answers: callback group of service clients whose answers another thread takes.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._stop, self.answers = node, threading.Event(), PollOnlyGroup()
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._threads = [
            threading.Thread(target=self._repeat, args=do, name=name, daemon=True)
            for name, *do in (('spinner', self._executor.spin_once, 0.1),
                              ('answers', take_answers, node, self.answers))]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=5.0)
        self._executor.shutdown(timeout_sec=1.0)

    def _repeat(self, do: Callable[..., object], *what: Any) -> None:
        """Do something until the end, whatever it raises: a node whose thread ends is deaf."""
        while not self._stop.is_set():
            try:
                do(*what)
            except (InvalidHandle, ExternalShutdownException):
                self._stop.wait(0.001)  # another thread has destroyed something just now
            except Exception as error:
                log_error(self._node, 'a callback failed; the node goes on', error)


def call(client: Client, request: Any, timeout_s: float,
         give_up: Callable[[], object] = lambda: False, server: Liveness | None = None) -> Any:
    """
    Call a service from a thread that does not spin the node.

    :param client: rclpy Client of a node that another thread spins.
    :param request: the service's request.
    :param timeout_s: most seconds to wait for the service and its answer together.
    :param give_up: asked several times a second whether to stop waiting.
    :param server: heartbeat.Liveness of the node that offers it, by which a new process of the
        same name is told from the one that was asked; None: without.
    :return: the response.
    :raises CallError: when the service is not there, leaves the ROS graph, or does not answer in
        time, or when the wait was given up.
    """
    deadline = time.monotonic() + timeout_s
    name, node = f'service {client.service_name}', 'its node' if server is None else server.name
    while not client.service_is_ready():
        if time.monotonic() >= deadline or give_up():
            raise CallError(f'{name}: nobody offers it after {timeout_s:.3g} s; start {node} and '
                            'wait until it says that it is ready')
        time.sleep(min(POLL_S, timeout_s))
    presence = None if server is None else server.presence()
    future = client.call_async(request)
    try:
        if not wait_for_answer(
                future, deadline, f'{name}: {node} has left the ROS graph during the call: it has '
                'ended or stands still', lambda: not client.service_is_ready() or (
                    presence is not None and presence.gone), give_up):
            raise CallError(f'{name}: no answer within {timeout_s:g} s; '
                            + (server and server.silence or f'{node} may be busy or stopped'))
    finally:
        client.remove_pending_request(future)  # else a lost call stays pending for ever
    return future.result()


def wait_for_answer(future: Future, deadline: float, left: str, gone: Callable[[], bool],
                    give_up: Callable[[], object] = lambda: False) -> bool:
    """
    Wait for what a server answers, however long it is silent.

    :param deadline: monotonic time.
    :param left: what to say when its server has left the ROS graph, as `gone` tells.
    :return: whether it has come.
    :raises CallError: with `left`.
    """
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    while not (future.done() or done.wait(min(POLL_S, max(deadline - time.monotonic(), 0.0)))):
        if gone():
            raise CallError(left)
        if time.monotonic() >= deadline or give_up():
            return False
    return True
