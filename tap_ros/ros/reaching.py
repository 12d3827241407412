# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goals of reach_goal: sent with an id of our own, and cancelled by it whoever gives up."""

from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass
from queue import Empty, SimpleQueue
import secrets
import threading
import time
from typing import Any
from weakref import WeakValueDictionary

from action_msgs.msg import GoalInfo, GoalStatus
from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from tap_msgs.action import ReachGoal
from tap_ros.ros.calls import call, CallError, log_error, POLL_S, wait_for_answer
from tap_ros.ros.goal_senders import ACTION, FEEDBACK, listeners
from tap_ros.ros.heartbeat import Liveness, Presence, publishers_present
from tap_ros.ros.subscriptions import PROCESS_BYTES, processes

STATUS, CANCEL = f'{ACTION}/_action/status', f'{ACTION}/_action/cancel_goal'
ANSWER_S = 5.0  # until an answer to a goal is held to be lost, and the goal is sent anew
CANCEL_S = 1.0  # until a cancel that is not answered is sent again
LATE_S = 1.0  # that feedback may come after the result
CLOSE_S = 5.0  # that cancelling may take when a client ends: more than a dead planner's lease
ENDS = {GoalStatus.STATUS_SUCCEEDED: 'succeeded', GoalStatus.STATUS_CANCELED: 'cancelled',
        GoalStatus.STATUS_ABORTED: 'aborted'}


class Goals:
    """
    The goals that a node has sent: none is left without an owner.

    A thread cancels by its id what was given up, again and again until the planner has answered.

    :param node: rclpy Node that another thread spins.
    :param server: Liveness of the planner.
    :param group: callback group of the action; answers: of the service that cancels.
    """

    def __init__(self, node: Node, server: Liveness, group: CallbackGroup,
                 answers: CallbackGroup) -> None:
        self.node, self.server = node, server
        self.action = ActionClient(node, ReachGoal, ACTION, callback_group=group)
        self.cancels = node.create_client(CancelGoal, CANCEL, callback_group=answers)
        # rclpy's action client drops feedback that comes with the result.
        node.create_subscription(ReachGoal.Impl.FeedbackMessage, FEEDBACK, self._take_feedback, 10,
                                 callback_group=group)
        self.sent = WeakValueDictionary[bytes, Reaching]()  # by their ids
        self.open: set[Reaching] = set()  # that have not ended
        self.given_up, self.closed = threading.Event(), threading.Event()
        threading.Thread(target=self._cancel, name='cancelling', daemon=True).start()

    def new_id(self) -> Any:
        """Return the id of a goal; the planner watches whom its first bytes name."""
        own = [process for process, names in listeners(self.node).items()
               if self.node.get_fully_qualified_name() in names]
        sender = own[0] if len(own) == 1 else secrets.token_bytes(PROCESS_BYTES)
        goal_id = GoalInfo().goal_id
        goal_id.uuid = list(sender + secrets.token_bytes(16 - PROCESS_BYTES))
        return goal_id

    def close(self) -> None:
        """Cancel what has not ended; wait until that was answered or the planner is gone."""
        for goal in list(self.open):
            goal.cancel()
        deadline = time.monotonic() + CLOSE_S
        while time.monotonic() < deadline and self.node.context.ok() and not all(
                goal.planner_gone for goal in list(self.open)):
            time.sleep(POLL_S)
        self.closed.set()
        self.given_up.set()

    def _take_feedback(self, message: Any) -> None:
        if goal := self.sent.get(bytes(message.goal_id.uuid)):
            goal.take(message.feedback)

    def _cancel(self) -> None:
        while not self.closed.wait(POLL_S):
            self.given_up.wait()
            self.given_up.clear()
            for goal in [one for one in list(self.open) if one.given_up]:
                if goal.is_cancelled():
                    self.open.discard(goal)
                else:
                    self.given_up.set()


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
    plan_samples. Leaving the iteration, or dropping this object, cancels nothing: its client owns
    the goal, and cancels it when it is closed. A wait that fails or is interrupted cancels it.

    :param goals: Goals of the node that sends it.
    :param goal: the action's goal.
    :param timeout_s: most seconds until the end; whoever waits for longer cancels the goal.
    :param accept_s: most seconds until it is accepted.
    :param on_feedback: called with each feedback by another thread; where it raises, the goal is
        cancelled. Without it they are kept for the iteration.
    :raises CallError: when no planner answers in time, or it rejects the goal.
    """

    def __init__(self, goals: Goals, goal: ReachGoal.Goal, timeout_s: float, accept_s: float,
                 on_feedback: Callable[[Any], object] | None = None) -> None:
        self._goals, self._timeout_s, self._name = goals, timeout_s, f'action {ACTION}'
        self._deadline = time.monotonic() + timeout_s
        self._feedback: SimpleQueue[Any] = SimpleQueue()
        self._take = on_feedback or self._feedback.put
        self._id = goals.new_id()
        self._lock = threading.Lock()  # nothing is sent after it was given up
        self.given_up = self._sent_anew = False
        self._accepted: Future | None = None  # once it was sent
        self._answer: Future | None = None
        self._answered = 0.0  # when
        self._presence: Presence | None = None  # of the planner that it was sent to
        if goals.closed.is_set():
            raise CallError(f'{self._name}: the client was closed')
        goals.open.add(self)
        try:
            self._begin(goal, min(accept_s, timeout_s))
        except BaseException:  # an interrupt, too
            self.cancel()
            raise

    def __iter__(self) -> Iterator[Any]:
        step = 0
        while not (self._feedback.empty() and self._is_over(step)):
            try:
                feedback = self._feedback.get(timeout=POLL_S)
            except Empty:
                continue
            except BaseException:
                self.cancel()
                raise
            step = feedback.step
            yield feedback
        self.result()  # raises what has ended it

    def cancel(self) -> None:
        """Have the goal cancelled, until the planner has answered; result tells the end."""
        with self._lock:
            self.given_up = True
        if self._accepted is None:  # it was never sent
            self._goals.open.discard(self)
        self._goals.given_up.set()

    def result(self) -> ReachResult:
        """
        Wait for the end.

        :raises CallError: when the planner leaves the ROS graph before, or the goal takes longer
            than it was given; then it is cancelled.
        """
        assert self._answer is not None
        try:
            if not wait_for_answer(
                    self._answer, self._deadline, f'{self._name}: {self._server.name} has left '
                    'the ROS graph before the goal ended; what the arm does now is up to its '
                    'driver', lambda: self.planner_gone):
                raise CallError(
                    f'the goal has not ended within {self._timeout_s:g} s and is cancelled'
                    + (self._server.silence and f'; {self._server.silence}'))
        except BaseException:
            self.cancel()
            raise
        answer = self._answer.result()
        if answer.status == GoalStatus.STATUS_UNKNOWN:
            raise CallError('the action server does not know the goal; was it started anew?')
        result = answer.result
        return ReachResult(ENDS[answer.status], result.success, result.message, result.steps,
                           result.expected_distance)

    @property
    def planner_gone(self) -> bool:
        """Whether the planner that it was sent to has left the ROS graph."""
        return not self._goals.cancels.service_is_ready() or (
            self._presence is not None and self._presence.gone)

    def is_cancelled(self) -> bool:
        """Ask once for the end of the goal; return whether nobody can pursue it any more."""
        accepted, request = self._accepted, CancelGoal.Request(
            goal_info=GoalInfo(goal_id=self._id))
        answered = accepted is not None and accepted.done()  # before this asks
        try:
            answer = call(self._goals.cancels, request, CANCEL_S, self._goals.closed.is_set)
        except Exception:  # whatever it is, one asks until it is answered
            return False
        if answer.return_code == CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID:
            # A cancel may overtake its goal; a new planner knows no goal of the one before.
            return answered or self.planner_gone
        return answer.return_code == CancelGoal.Response.ERROR_GOAL_TERMINATED or any(
            one.goal_id == self._id for one in answer.goals_canceling)

    @property
    def _server(self) -> Liveness:
        return self._goals.server

    def _begin(self, goal: ReachGoal.Goal, accept_s: float) -> None:
        """Send the goal, and wait until it is accepted."""
        deadline = time.monotonic() + accept_s
        while not self._goals.action.server_is_ready():
            if time.monotonic() >= deadline:
                raise CallError(f'{self._name}: nobody offers it after {accept_s:.3g} s; start '
                                f'{self._server.name}')
            time.sleep(POLL_S)
        self._presence = publishers_present(self._goals.node, STATUS)
        while not (accepted := self._sent(goal, deadline, accept_s)).accepted:
            if not self._sent_anew or time.monotonic() >= deadline:
                self._goals.open.discard(self)
                raise CallError(f'{self._name}: the goal was rejected; the log of '
                                f'{self._server.name} says why')
            time.sleep(CANCEL_S)  # the one whose answer was lost has yet to end
        self._answer = self._in_executor(accepted.get_result_async, deadline)
        self._answer.add_done_callback(self._note_answer)

    def _sent(self, goal: ReachGoal.Goal, deadline: float, accept_s: float) -> ClientGoalHandle:
        """
        Return the planner's answer to the goal; one whose answer is lost is sent anew.

        An answer is lost when it leaves before the planner has discovered who waits for it.
        """
        server = self._server
        while True:
            answer = self._in_executor(lambda: self._send(goal), deadline)
            if wait_for_answer(
                    answer, min(deadline, time.monotonic() + ANSWER_S), f'{self._name}: '
                    f'{server.name} has left the ROS graph before it answered',
                    lambda: self.planner_gone):
                return answer.result()
            while time.monotonic() < deadline and not self.is_cancelled():
                time.sleep(POLL_S)
            if time.monotonic() >= deadline:
                count = len(processes(self._goals.node.get_publishers_info_by_topic(
                    self._goals.node.resolve_topic_name(STATUS))))
                raise CallError(f'{self._name}: no answer to the goal within {accept_s:g} s; ' + (
                    f'{count} nodes serve it, leave one' if count > 1 else
                    server.silence or f'{server.name} may be busy or stopped'))
            del self._goals.sent[bytes(self._id.uuid)]
            self._id, self._sent_anew = self._goals.new_id(), True

    def _send(self, goal: ReachGoal.Goal) -> Future:
        with self._lock:
            if self.given_up:
                raise CallError(f'{self._name}: given up')
            self._goals.sent[bytes(self._id.uuid)] = self
            self._accepted = self._goals.action.send_goal_async(goal, None, self._id)
            return self._accepted

    def take(self, feedback: Any) -> None:
        """Keep a feedback, or give it to on_feedback."""
        try:
            self._take(feedback)
        except Exception as error:  # it would end the thread that spins the node
            log_error(self._goals.node, f'{self._name}: on_feedback', error)
            self.cancel()

    def _note_answer(self, _: Future) -> None:
        self._answered = time.monotonic()
        self._goals.open.discard(self)

    def _is_over(self, step: int) -> bool:
        """Return whether no feedback is to come after that of a step."""
        assert self._answer is not None
        if self._answered:
            return (step >= self._answer.result().result.steps
                    or time.monotonic() > self._answered + LATE_S)
        return time.monotonic() > self._deadline or self.planner_gone

    def _in_executor(self, function: Callable[[], Future], deadline: float) -> Future:
        """
        Return what a function returns, called in the thread that spins the node.

        rclpy's action client takes down a request only after it was sent: an answer that another
        thread handles in between is lost.

        :raises CallError: when the node is not spun, or its thread is busy until the deadline.
        """
        node, outcome = self._goals.node, futures.Future[Future]()

        def run() -> None:
            try:
                outcome.set_result(function())
            except Exception as error:  # it would end the executor
                outcome.set_exception(error)

        if node.executor is None:
            raise CallError(f'node {node.get_name()} is not spun')
        node.executor.create_task(run)
        try:
            return outcome.result(max(deadline - time.monotonic(), POLL_S))
        except futures.TimeoutError as error:
            raise CallError(f'node {node.get_name()}: its callbacks keep it busy') from error
