# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What explorer_node asks the other nodes for, on behalf of browsers."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import threading
import time
import traceback
from typing import Any, TYPE_CHECKING

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Pose
from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectState, ObjectStates
from tap_msgs.srv import PredictSubgoal, ResetScene, SetGoal
from tap_ros.errors import TapError
from tap_ros.nodes.clients import call, CallError, cancel_goal, send_goal, wait_for_result
from tap_ros.nodes.explorer.commands import (
    Cancel,
    Command,
    CommandError,
    Move,
    parse_command,
    Photograph,
    Predict,
    Reach,
    Reset,
)
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.topics import SERVICE_QOS
from tap_ros.text import escaped

if TYPE_CHECKING:
    from rclpy.action.client import ClientGoalHandle
    from rclpy.node import Node

TIMEOUT_S = 20.0  # of a service
GOAL_TIMEOUT_S = 600.0  # of a goal: 75 steps take half a minute
END_S = 2.0  # that a cancel may take when the node ends
WAITING = 8  # commands that may wait; more are refused


class ExplorerCalls:
    """
    Carries out the commands of browsers, each in a thread of its own; one goal at a time.

    :param node: rclpy Node that another thread spins.
    :param told: called with a text for people when something has happened; any thread.
    :param failed: likewise, when something could not be done.
    :param answered: called with a PredictSubgoal.Response, a success.
    :param photographed: called without arguments; takes the camera's picture as the goal.
    :ivar stage: what the goal in progress is doing, '' without one.
    """

    def __init__(self, node: 'Node', told: Callable[[str], object],
                 failed: Callable[[str], object],
                 answered: Callable[[PredictSubgoal.Response], object],
                 photographed: Callable[[], object]) -> None:
        self._node, self._told, self._failed = node, told, failed
        self._answered, self._photographed = answered, photographed
        group = ReentrantCallbackGroup()
        self._reset = node.create_client(
            ResetScene, 'sim/reset', qos_profile=SERVICE_QOS, callback_group=group)
        self._move = node.create_client(
            SetGoal, 'sim/set_goal', qos_profile=SERVICE_QOS, callback_group=group)
        self._predict = node.create_client(
            PredictSubgoal, 'predict_subgoal', qos_profile=SERVICE_QOS, callback_group=group)
        self._reach = ActionClient(node, ReachGoal, 'reach_goal', callback_group=group)
        self._alive = {name: Liveness(node, name, group)
                       for name in ('sim_node', 'predictor_node', 'visual_mpc_node')}
        self._lock = threading.Lock()
        self._waiting = 0
        self._goal: ClientGoalHandle | None = None
        self._running = self._cancelled = self._ending = False
        self.stage = ''
        self._pool = ThreadPoolExecutor(4, 'explorer')
        self._stopper = ThreadPoolExecutor(1, 'explorer cancel')  # nothing may wait before it

    @property
    def running(self) -> bool:
        """Whether a goal that a browser asked for is in progress."""
        return self._running

    @property
    def simulator(self) -> bool:
        """Whether a simulator is there."""
        return bool(self._reset.service_is_ready())

    @property
    def movable(self) -> bool:
        """Whether the simulator takes another goal."""
        return bool(self._move.service_is_ready())

    def do(self, text: str | bytes) -> None:
        """
        Begin what a browser asks for.

        :raises CommandError: when it makes no sense, or cannot begin now.
        """
        command = parse_command(text)
        if isinstance(command, Cancel):
            self._cancel()
            return
        with self._lock:
            if self._waiting >= WAITING:
                raise CommandError('busy: earlier commands wait for their answers; try again')
            if isinstance(command, Reach):
                if self._running:
                    raise CommandError('a goal is in progress; cancel it or wait for its end')
                self._running, self._cancelled = True, False
            self._waiting += 1
        self._pool.submit(self._carry_out, command)

    def close(self) -> None:
        """Cancel the goal that a browser began, and end; in the thread that spins the node."""
        self._ending = self._cancelled = True
        goal, executor = self._goal, self._node.executor
        if goal is not None:
            goal.cancel_goal_async()
        deadline = time.monotonic() + END_S
        while self._running and executor is not None and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)  # nobody else does any more
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._stopper.shutdown(wait=False, cancel_futures=True)

    # In the threads of the pool

    def _carry_out(self, command: Command) -> None:
        try:
            _DOING[type(command)](self, command)
        except TapError as error:
            self._failed(escaped(error, 1000))
        except Exception as error:
            if self._ending:  # the node is being taken down
                return
            self._node.get_logger().error(traceback.format_exc())
            self._failed(f'internal error: {type(error).__name__}: {escaped(error)}')
        finally:
            with self._lock:
                self._waiting -= 1
                if isinstance(command, Reach):
                    self._running, self._goal, self.stage = False, None, ''

    def _do_reset(self, command: Reset) -> None:
        response = self._ask(self._reset, ResetScene.Request(
            task=command.task, seed=command.seed), 'sim_node')
        self._told(f'reset: {escaped(response.message)}')

    def _do_move(self, command: Move) -> None:
        objects = ObjectStates(source=ObjectStates.SOURCE_TRACKED, objects=[
            ObjectState(name=command.name, u=command.u, v=command.v, pose=Pose())])
        self._ask(self._move, SetGoal.Request(objects=objects), 'sim_node')
        self._told(f'goal: {escaped(command.name)} to pixel '
                   f'{command.u:.1f}, {command.v:.1f}')

    def _do_photograph(self, _: Photograph) -> None:
        self._photographed()
        self._told('goal: what the camera sees now')

    def _do_predict(self, command: Predict) -> None:
        response = self._ask(self._predict, PredictSubgoal.Request(
            num_samples=command.samples, recursion_depth=command.levels,
            seed=command.seed), 'predictor_node')
        self._answered(response)
        self._told(f'predicted in {response.model_time_ms:.0f} ms: '
                   f'{escaped(response.message, 300)}')

    def _do_reach(self, command: Reach) -> None:
        goal = ReachGoal.Goal(mode=command.mode, num_samples=command.samples,
                              recursion_depth=command.levels, seed=command.seed)
        words = 'via subgoal' if command.mode == 'subgoal' else 'direct'
        self.stage = f'{words}: waiting for the planner'
        alive = self._alive['visual_mpc_node']
        if self._is_cancelled():
            raise CallError(f'{words}: cancelled before it began')
        handle = send_goal(self._reach, goal, TIMEOUT_S, self._on_feedback, alive)
        self._goal = handle
        if self._is_cancelled():  # meanwhile
            cancel_goal(handle)
        self._told(f'{words}: begun')
        status, result = wait_for_result(handle, GOAL_TIMEOUT_S, alive)
        end = {GoalStatus.STATUS_CANCELED: 'cancelled'}.get(status, escaped(result.message, 1000))
        self._told(f'{words}: {end} ({result.steps} steps)')

    def _cancel(self) -> None:
        """End the goal in progress, also one that is about to begin."""
        with self._lock:
            if not self._running:
                raise CommandError('there is no goal to cancel')
            self._cancelled = True
        goal = self._goal
        if goal is not None:
            self._stopper.submit(self._send_cancel, goal)

    def _send_cancel(self, goal: 'ClientGoalHandle') -> None:
        try:
            cancel_goal(goal)
        except CallError as error:
            self._failed(f'cancel: {escaped(error)}')

    def _is_cancelled(self) -> bool:
        return self._cancelled

    def _on_feedback(self, feedback: ReachGoal.Feedback) -> None:
        self.stage = (f'step {feedback.step}, to the {escaped(feedback.stage, 60)}, plan in '
                      f'{feedback.planning_ms:.0f} ms')

    def _ask(self, client: Any, request: Any, name: str) -> Any:
        """Call a service; a refusal is raised, too."""
        response = call(client, request, TIMEOUT_S, lambda: self._ending, self._alive[name])
        if not response.success:
            raise CallError(f'{client.service_name}: {response.message}')
        return response


_DOING: dict[type, Callable[[ExplorerCalls, Any], None]] = {
    Reset: ExplorerCalls._do_reset, Move: ExplorerCalls._do_move,
    Photograph: ExplorerCalls._do_photograph, Predict: ExplorerCalls._do_predict,
    Reach: ExplorerCalls._do_reach}
