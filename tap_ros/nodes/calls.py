# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calls and goals with a time-out, of a node that another thread spins."""

from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass
from queue import SimpleQueue
import threading
import time
from typing import Any, Self, TYPE_CHECKING, TypeVar

from action_msgs.msg import GoalStatus
from rclpy.executors import SingleThreadedExecutor
from tap_ros.errors import TapError

if TYPE_CHECKING:
    from rclpy.action import ActionClient
    from rclpy.action.client import ClientGoalHandle
    from rclpy.client import Client
    from rclpy.node import Node
    from rclpy.task import Future
    from tap_ros.nodes.heartbeat import Liveness

Found = TypeVar('Found')

NEWBORN_S = 0.7  # until others have heard of a node that has just started
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
    """

    def __init__(self, node: 'Node') -> None:
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, name='spinner', daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)
        self._executor.shutdown(timeout_sec=1.0)

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.1)


def call(client: 'Client', request: Any, timeout_s: float,
         give_up: Callable[[], bool] = lambda: False, server: 'Liveness | None' = None) -> Any:
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


def in_executor(node: 'Node', function: Callable[[], Found], timeout_s: float) -> Found:
    """
    Call a function in the thread that spins a node, where no answer is handled meanwhile.

    rclpy's action client takes down a request only after it was sent: an answer that is handled in
    between by another thread is lost.

    :param node: rclpy Node that one other thread spins.
    :param function: called without arguments.
    :param timeout_s: most seconds to wait.
    :return: what the function returns; what it raises is raised.
    :raises CallError: when the node is not spun, or its thread is busy for too long.
    """
    outcome: futures.Future[Found] = futures.Future()

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


def wait_for_future(future: 'Future', timeout_s: float) -> bool:
    """Wait until a future is done, without spinning; tell whether it is."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    return done.wait(max(timeout_s, 0.0))


def send_goal(action_client: 'ActionClient', goal: Any, timeout_s: float,
              on_feedback: Callable[[Any], object] | None = None,
              server: 'Liveness | None' = None) -> 'ClientGoalHandle':
    """
    Send a goal and wait until it is accepted.

    :param action_client: rclpy ActionClient of a node that another thread spins.
    :param goal: the action's goal.
    :param timeout_s: most seconds to wait.
    :param on_feedback: called with each feedback message, or None.
    :param server: heartbeat.Liveness of the node that offers it, as in call.
    :return: the client's goal handle.
    :raises CallError: when no server answers in time, or it rejects the goal.
    """
    name = f'action {action_client._action_name}'
    deadline = time.monotonic() + timeout_s
    _expect_alive(name, timeout_s, server)
    if not action_client.wait_for_server(timeout_sec=timeout_s):
        raise CallError(f'{name}: nobody offers it after {timeout_s:g} s; start {_named(server)}')
    told = None if on_feedback is None else lambda message: on_feedback(message.feedback)
    future = in_executor(
        action_client._node, lambda: action_client.send_goal_async(goal, told), timeout_s)
    if not _wait_for_server(future, deadline, f'{name}: its node ended before it answered',
                            action_client.server_is_ready, server):
        raise CallError(f'{name}: no answer to the goal within {timeout_s:g} s')
    handle = future.result()
    if not handle.accepted:
        raise CallError(f'{name}: the goal was rejected; the log of {_named(server)} says why')
    return handle


def cancel_goal(handle: 'ClientGoalHandle', timeout_s: float = 1.0) -> 'Future':
    """Ask for the end of a goal, as in_executor; return the future of the answer."""
    return in_executor(handle._action_client._node, handle.cancel_goal_async, timeout_s)


def wait_for_result(handle: 'ClientGoalHandle', timeout_s: float,
                    server: 'Liveness | None' = None) -> tuple[int, Any]:
    """
    Wait for the end of a goal; cancel it when it takes too long.

    :return: status, one of the STATUS_ constants of action_msgs/GoalStatus, and the result.
    :raises CallError: when it has not ended in time, or the node that pursues it has.
    """
    client = handle._action_client
    deadline = time.monotonic() + timeout_s
    future = in_executor(client._node, handle.get_result_async, timeout_s)
    if not _wait_for_server(
            future, deadline, f'action {client._action_name}: its node ended before the goal did; '
            'what the arm does now is up to its driver', client.server_is_ready, server):
        cancelled = wait_for_future(cancel_goal(handle), 1.0)
        raise CallError(
            f'the goal has not ended within {timeout_s:g} s and '
            + ('was cancelled' if cancelled else 'its node does not answer the cancel'))
    answer = future.result()
    if answer.status == GoalStatus.STATUS_UNKNOWN:
        raise CallError('the action server does not know the goal; was it started anew?')
    return answer.status, answer.result


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

    A feedback has step, stage ('subgoal' or 'goal'), expected_distance (px) and planning_ms.

    :ivar handle: rclpy's handle of the goal.
    """

    def __init__(self, handle: 'ClientGoalHandle', feedback: 'SimpleQueue[Any]',
                 deadline: float, server: 'Liveness') -> None:
        self.handle = handle
        self._feedback, self._deadline, self._server = feedback, deadline, server
        self._result: ReachResult | Exception = CallError('reach_goal: ended without a result')
        self._thread = threading.Thread(target=self._wait, name='reaching', daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Any]:
        yield from iter(self._feedback.get, None)
        self._feedback.put(None)
        self.result()  # raises what has ended it

    def cancel(self) -> None:
        """Ask for the end of the goal; result tells when it has come."""
        cancel_goal(self.handle)

    def result(self) -> ReachResult:
        """
        Wait for the end.

        :raises CallError: when the planner ends before, or takes longer than it was given; then
            the goal is cancelled.
        """
        self._thread.join()
        if isinstance(self._result, Exception):
            raise self._result
        return self._result

    def _wait(self) -> None:
        try:
            status, result = wait_for_result(
                self.handle, max(self._deadline - time.monotonic(), 0.0), self._server)
            self._result = ReachResult(
                ENDS.get(status, 'aborted'), result.success, result.message, result.steps,
                result.expected_distance)
        except Exception as error:
            self._result = error
        self._feedback.put(None)


def _named(server: 'Liveness | None') -> str:
    return 'its node' if server is None else server.name


def _expect_alive(name: str, timeout_s: float, server: 'Liveness | None') -> None:
    """Raise CallError if a node that was heard before has ended."""
    if server is not None and not server.wait_until_alive(min(NEWBORN_S, timeout_s)):
        raise CallError(f'{name}: its node, {server.name}, has ended; start it again')


def _wait_for_server(future: 'Future', deadline: float, ended: str, ready: Callable[[], bool],
                     server: 'Liveness | None', give_up: Callable[[], bool] = lambda: False
                     ) -> bool:
    """
    Wait for what a server answers; tell whether it has come before the deadline.

    :raises CallError: saying `ended`, when the node of the server ends meanwhile.
    """
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    while not done.wait(min(POLL_S, max(deadline - time.monotonic(), 0.0))):
        if not ready() or (server is not None and server.dead):
            raise CallError(ended)
        if time.monotonic() >= deadline or give_up():
            return False
    return True
