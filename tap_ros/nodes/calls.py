# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calls and goals with a time-out, of a node that another thread spins."""

from collections.abc import Callable, Iterator
from concurrent import futures
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
import threading
import time
from typing import Any, Self

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from tap_ros.errors import TapError
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.services import wait_for_some
from tap_ros.nodes.subscriptions import PollOnlyGroup

NEWBORN_S = 0.7  # until other nodes have discovered one that has just started
POLL_S = 0.05  # between two looks at whether a server still lives
ENDS = {GoalStatus.STATUS_SUCCEEDED: 'succeeded', GoalStatus.STATUS_CANCELED: 'cancelled',
        GoalStatus.STATUS_ABORTED: 'aborted'}


class CallError(TapError):
    """A service, action or topic did not answer in time, or refused."""


class Spinner:
    """
    Spin a node in the background, for as long as the with-block lasts.

    A thread that keeps spinning answers ten times faster than spinning once per call.

    :param node: rclpy Node; destroying it stays with the caller.
    :ivar answers: callback group for service clients: another thread takes their answers, without
        the executor, which looks at everything that the node has, three times for an answer.
    """

    def __init__(self, node: Node) -> None:
        self._node, self.answers = node, PollOnlyGroup()
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=target, name=name, daemon=True) for target, name
                         in ((self._spin, 'spinner'), (self._take_answers, 'answers'))]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=5.0)
        self._executor.shutdown(timeout_sec=1.0)

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    def _take_answers(self) -> None:
        while not self._stop.is_set():
            clients = [one for one in self._node.clients if one.callback_group is self.answers]
            if not clients:
                self._stop.wait(POLL_S)
                continue
            with suppress(InvalidHandle):  # of one that was destroyed just now
                for client in wait_for_some(self._node.context, clients):
                    header, answer = client.handle.take_response(client.srv_type.Response)
                    if header is not None:
                        with suppress(KeyError):  # given up
                            client.get_pending_request(
                                header.request_id.sequence_number).set_result(answer)


def call(client: Client, request: Any, timeout_s: float,
         give_up: Callable[[], bool] = lambda: False, server: Liveness | None = None) -> Any:
    """
    Call a service from a thread that does not spin the node.

    :param client: rclpy Client of a node that another thread spins.
    :param request: the service's request.
    :param timeout_s: most seconds to wait for the service and its answer together.
    :param give_up: asked several times a second whether to stop waiting.
    :param server: heartbeat.Liveness of the node that offers it, by which its death is noticed
        sooner; None: without.
    :return: the response.
    :raises CallError: when the service is not there, ends, or does not answer in time, or when
        the wait was given up.
    """
    deadline = time.monotonic() + timeout_s
    name = f'service {client.service_name}'
    _expect_alive(name, timeout_s, server)
    while not client.wait_for_service(timeout_sec=min(0.1, timeout_s)):
        if time.monotonic() >= deadline or give_up():
            raise CallError(f'{name}: nobody offers it after {timeout_s:g} s; start '
                            f'{_named(server)} and wait until it says that it is ready')
    future = client.call_async(request)
    try:
        if not _wait_for_server(future, deadline, f'{name}: its node ended during the call',
                                client.service_is_ready, server, give_up):
            raise CallError(f'{name}: no answer within {timeout_s:g} s; {_named(server)} may be '
                            'busy or stopped')
    finally:
        client.remove_pending_request(future)  # else a lost call stays pending for ever
    return future.result()


@dataclass(frozen=True)
class ReachResult:
    """
    How a goal ended.

    :param end: 'succeeded' (also when the budget was spent), 'cancelled' or 'aborted'.
    :param success: whether the goal was reached.
    :param message: why not, or what was reached.
    :param steps: commands sent.
    :param expected_distance: px, mean over the objects, at the end.
    """

    end: str
    success: bool
    message: str
    steps: int
    expected_distance: float


class Reaching:
    """
    A goal that the planner pursues; iterate over it for feedback until it ends.

    A feedback has step, stage ('subgoal' or 'goal'), expected_distance (px), planning_ms and
    plan_samples.

    :param action_client: rclpy ActionClient of a node that another thread spins.
    :param goal: the action's goal.
    :param timeout_s: most seconds until the end; whoever waits for longer cancels the goal.
    :param accept_s: most seconds until it is accepted.
    :param on_feedback: called with each feedback by another thread; without it they are kept for
        the iteration.
    :param server: Liveness of the node that offers the action, as in call.
    :ivar handle: rclpy's handle of the goal.
    :raises CallError: when no server answers in time, or it rejects the goal.
    """

    def __init__(self, action_client: ActionClient, goal: Any, timeout_s: float,
                 accept_s: float = 20.0, on_feedback: Callable[[Any], object] | None = None,
                 server: Liveness | None = None) -> None:
        self._client, self._server, self._timeout_s = action_client, server, timeout_s
        self._name = f'action {action_client._action_name}'
        self._deadline = time.monotonic() + timeout_s
        self._feedback: SimpleQueue[Any] = SimpleQueue()
        take, accept_s = on_feedback or self._feedback.put, min(accept_s, timeout_s)
        deadline = time.monotonic() + accept_s
        _expect_alive(self._name, accept_s, server)
        if not action_client.wait_for_server(timeout_sec=accept_s):
            raise CallError(f'{self._name}: nobody offers it after {accept_s:g} s; start '
                            f'{_named(server)}')
        accepted = self._in_executor(lambda: action_client.send_goal_async(
            goal, lambda message: take(message.feedback)), accept_s)
        if not _wait_for_server(accepted, deadline, f'{self._name}: its node ended before it '
                                'answered', action_client.server_is_ready, server):
            raise CallError(f'{self._name}: no answer to the goal within {accept_s:g} s')
        self.handle = accepted.result()
        if not self.handle.accepted:
            raise CallError(f'{self._name}: the goal was rejected; the log of {_named(server)} '
                            'says why')
        self._answer = self._in_executor(self.handle.get_result_async, accept_s)

    def __iter__(self) -> Iterator[Any]:
        while not (self._feedback.empty() and self._is_over()):
            with suppress(Empty):
                yield self._feedback.get(timeout=POLL_S)
        self.result()  # raises what has ended it

    def cancel(self) -> None:
        """Ask for the end of the goal; result tells when it has come."""
        self._in_executor(self.handle.cancel_goal_async, 1.0)

    def result(self) -> ReachResult:
        """
        Wait for the end.

        :raises CallError: when the planner ends before, or takes longer than it was given; then
            the goal is cancelled.
        """
        if not _wait_for_server(
                self._answer, self._deadline, f'{self._name}: its node ended before the goal did; '
                'what the arm does now is up to its driver', self._client.server_is_ready,
                self._server):
            self.cancel()
            raise CallError(f'the goal has not ended within {self._timeout_s:g} s and was '
                            'cancelled')
        answer = self._answer.result()
        if answer.status == GoalStatus.STATUS_UNKNOWN:
            raise CallError('the action server does not know the goal; was it started anew?')
        result = answer.result
        return ReachResult(ENDS[answer.status], result.success, result.message, result.steps,
                           result.expected_distance)

    def _is_over(self) -> bool:
        """Return whether result would return or raise at once."""
        return (self._answer.done() or time.monotonic() > self._deadline
                or not self._client.server_is_ready()
                or self._server is not None and self._server.dead)

    def _in_executor(self, function: Callable[[], Future], timeout_s: float) -> Future:
        """
        Return what a function returns, called in the thread that spins the node.

        rclpy's action client takes down a request only after it was sent: an answer that another
        thread handles in between is lost.

        :raises CallError: when the node is not spun, or its thread is busy for too long.
        """
        node, outcome = self._client._node, futures.Future[Future]()

        def run() -> None:
            try:
                outcome.set_result(function())
            except Exception as error:  # it would end the executor
                outcome.set_exception(error)

        if node.executor is None:
            raise CallError(f'node {node.get_name()} is not spun')
        node.executor.create_task(run)
        try:
            return outcome.result(timeout_s)
        except futures.TimeoutError as error:
            raise CallError(f'node {node.get_name()}: its callbacks have kept it busy for '
                            f'{timeout_s:g} s') from error


def _named(server: Liveness | None) -> str:
    return 'its node' if server is None else server.name


def _expect_alive(name: str, timeout_s: float, server: Liveness | None) -> None:
    """Raise CallError if a node whose heartbeat was received before has ended."""
    if server is not None and not server.wait_until_alive(min(NEWBORN_S, timeout_s)):
        raise CallError(f'{name}: its node, {server.name}, has ended; start it again')


def _wait_for_server(future: Future, deadline: float, ended: str, ready: Callable[[], bool],
                     server: Liveness | None, give_up: Callable[[], bool] = lambda: False
                     ) -> bool:
    """
    Wait for what a server answers; tell whether it has come before the deadline.

    :raises CallError: saying `ended`, when the node of the server ends meanwhile.
    """
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    while not (future.done() or done.wait(min(POLL_S, max(deadline - time.monotonic(), 0.0)))):
        if not ready() or (server is not None and server.dead):
            raise CallError(ended)
        if time.monotonic() >= deadline or give_up():
            return False
    return True
