# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves reach_goal: drives planning.reach by what is seen, and sends its commands."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
import math
from pathlib import Path
import threading
import time
from typing import Any, cast

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from tap_msgs.action import ReachGoal
from tap_msgs.msg import CommandRefused
from tap_ros.base.errors import ConfigError, PlanningError, TapError
from tap_ros.base.text import escaped, listing
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import JOINT_STATES, TWIST
from tap_ros.nodes.planner import settings
from tap_ros.nodes.planner.arm import ArmCommander
from tap_ros.nodes.planner.goals import GoalSource
from tap_ros.nodes.planner.plan_view import draw_plan
from tap_ros.nodes.planner.planner_inputs import PlannerInputs
from tap_ros.nodes.planner.settings import declare_parameters
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.reach import Command, End, Reach, SelectTargets
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.ros.calls import reason
from tap_ros.ros.client import Client
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.goal_senders import watch_sender
from tap_ros.ros.lifecycle import LifecycleBase
from tap_ros.ros.robot_view import warn_if_unlike
from tap_ros.ros.subscriptions import publishers_of, steady_timer
from tap_ros.ros.topics import camera_topics, encode_image, goal_topics, STREAM, to_stamp
from tap_ros.weights import find_forward_model

BUSY = 'another goal is in progress; cancel it or wait for its end'
ENDING = 'the node is ending'
CANCELLED = 'cancelled'
DESERTED = 'the client that sent the goal has left the ROS graph'
WATCH_S = 0.2  # s between two looks at whether the client of a goal is still there
GONE_S = 4.0  # s after which a node that was killed has left the ROS graph
KNOWN_S = 1.0  # s after which rclpy knows of a cancel that _on_cancel was told of
RESULT_S = 60  # s that a result, and the pictures of its request, are kept for who asks for it


class Cancelled(TapError):
    """The goal was cancelled or deserted, or the node is ending or not active any more."""


class VisualMpcNode(LifecycleBase):
    """
    Executes one goal at a time, in a thread that callbacks do not need.

    A second goal is rejected meanwhile. Whatever the way a goal ends, the last command is zero.
    While the node is not active, goals are aborted with the reason.
    """

    num_threads = 4
    _mpc: VisualMPC  # while configured

    def __init__(self, **options: Any) -> None:
        super().__init__('visual_mpc_node', **options)
        self.params = declare_parameters(self)
        self._halt = ''  # why no goal may go on
        self._ended: tuple[ServerGoalHandle | None, str] = None, ''  # that has to end, and why
        self._sender_gone: tuple[ServerGoalHandle, Callable[[], bool]] | None = None
        self._busy = threading.Lock()  # held while a goal is executed
        self._refusals: deque[tuple[int, str]] = deque(maxlen=10)
        # Plans in one thread: each that has planned keeps 70 MB of its own, by malloc's arenas.
        self._worker = ThreadPoolExecutor(1, 'planning')
        self.autostart('configure')
        self._diagnostics = Diagnostics(
            self, [JOINT_STATES.name, *(name for _, name in camera_topics(self.params).values())],
            [name for _, name in goal_topics(self.params['robot_mask']).values()],
            idle=self.why_not)
        self._inputs = PlannerInputs(
            self, self.params, lambda: self._model.camera_crop, self._diagnostics.received)
        self._sensors = self._inputs.sensors
        client = Client(node=self)
        client.is_ready('predict')  # looked for now, found by the time of the first goal
        self._goal = GoalSource(self, self.params, self._inputs, client, self._diagnostics)
        self._arm = ArmCommander(self, self.params, self._sensors)
        self.create_subscription(CommandRefused, 'arm/refused', self._on_refused, STREAM)
        self._overlay = self.create_publisher(Image, 'plan/overlay', STREAM)
        self._distance = self.create_publisher(Float64, 'plan/distance', STREAM)
        group = ReentrantCallbackGroup()  # answers and cancels arrive while a goal is executed
        self._server = ActionServer(
            self, ReachGoal, 'reach_goal', self._execute, callback_group=group,
            goal_callback=self._on_goal, cancel_callback=self._on_cancel,
            result_timeout=RESULT_S)
        steady_timer(self, WATCH_S, self._watch_sender, group)
        self.autostart('activate')

    def close(self) -> None:
        """End the goal in progress, and see that the command to stop has left."""
        self.active = False
        self._end_all(ENDING)
        self._arm.close(1.0)
        self._worker.shutdown(wait=False)

    def destroy_node(self) -> None:
        """Leave the ROS graph: rclpy leaves action servers to who has made them."""
        self._server.destroy()
        super().destroy_node()

    # Lifecycle

    def load(self) -> str:
        """Load the weights; return device and file."""
        self._check_idle()
        self._mpc = self._worker.submit(settings.load_planner, self.params).result()
        warn_if_unlike(self, self.params['robot_mask'], [self._model.config.robot_mask],
                       'forward model')
        return f'{self.params["device"]}, {self.params["weights"]}'

    def unload(self) -> None:
        """Release the weights."""
        self._check_idle()
        with suppress(AttributeError):  # where there are none
            del self._mpc

    def files(self) -> list[Path]:
        """Return the file of the weights."""
        return [find_forward_model(self.params['weights'])]

    def resume(self) -> None:
        """Serve goals again, once the last one has ended."""
        self._check_idle()
        if self._halt == ENDING:
            raise PlanningError(ENDING)
        self._halt = ''

    def pause(self) -> None:
        """Stop the arm at once, and let the goal in progress end."""
        self._end_all('the node was deactivated')

    def _check_idle(self) -> None:
        """Raise PlanningError while the last goal has not ended: a plan may take its time."""
        if self._busy.locked():
            raise PlanningError('the last goal has not ended yet; try again')

    def _end_all(self, why: str) -> None:
        """Let no goal go on; wait for the one in progress."""
        self._halt = why
        self._arm.end()
        self._sensors.wake()
        if self._busy.acquire(timeout=10.0):  # longer than a plan takes
            self._busy.release()

    @property
    def _model(self) -> LearnedForwardModel:
        """Return the forward model of the weights."""
        return cast(LearnedForwardModel, self._mpc.model)  # as load_planner has loaded it

    # Callbacks

    def _on_goal(self, _: ReachGoal.Goal) -> GoalResponse:
        if self._busy.locked():
            self.get_logger().warning(f'reach_goal rejected: {BUSY}')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        self._end(handle, CANCELLED)  # its state is still executing
        return CancelResponse.ACCEPT

    def _watch_sender(self) -> None:
        """End the goal when nobody is left who could cancel it."""
        handle, gone = self._sender_gone or (None, None)
        if gone is not None and self._ended[0] is not handle and gone():
            self._end(handle, DESERTED)

    def _end(self, handle: ServerGoalHandle | None, why: str) -> None:
        """Let a goal not go on; the arm stops at once, as a plan may be in progress."""
        self._ended = handle, why
        self._arm.end(handle)
        self._sensors.wake()

    def _on_refused(self, message: CommandRefused) -> None:
        self._refusals.append((to_nanoseconds(message.header.stamp), escaped(message.message)))
        self._sensors.wake()

    def _execute(self, handle: ServerGoalHandle) -> ReachGoal.Result:
        """Run a goal to its end; runs in a thread of the executor."""
        result = ReachGoal.Result()
        # Two goals may have been accepted at the same time.
        result.message = self.why_not() or ('' if self._busy.acquire(blocking=False) else BUSY)
        if result.message:
            self.get_logger().warning(f'reach_goal refused: {result.message}')
            handle.abort()
            return result
        try:
            self._sender_gone = handle, watch_sender(self, bytes(handle.goal_id.uuid))
            self._expect_no_rival(handle)
            self._arm.begin(handle)
            self._go_on(handle)
            self._worker.submit(self._reach, handle, time.monotonic(), result).result()
            handle.succeed()
        except Cancelled as error:
            result.message, deadline = str(error), time.monotonic() + KNOWN_S
            while self._why_end(handle) == CANCELLED and time.monotonic() < deadline and (
                    not handle.is_cancel_requested):
                time.sleep(0.01)
            if handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
        except Exception as error:
            if not isinstance(error, ConfigError):  # else who sent the goal was wrong
                self._diagnostics.error(error)
            result.message = reason(self, 'reach_goal', error)
            handle.abort()
        finally:
            try:
                self._sender_gone = None
                self._arm.end(handle)
            finally:
                self._busy.release()
        self.get_logger().info(
            f'reach_goal ended after {result.steps} steps: {escaped(result.message, 1000)}')
        return result

    def _expect_no_rival(self, handle: ServerGoalHandle) -> None:
        """Raise PlanningError if another node may command this arm."""
        deadline = time.monotonic() + GONE_S
        while True:
            (topic, publishers), = publishers_of(self, TWIST.name).items()
            others = sorted(name for names in publishers.values() for name in names)
            if (own := self.get_fully_qualified_name()) in others:
                others.remove(own)  # another one may have the same name
            if not others:
                return
            self._go_on(handle)
            if time.monotonic() > deadline:
                raise PlanningError(f'{listing(others)} may command this arm, too, by {topic}: '
                                    'end it, or remap the topic')
            time.sleep(WATCH_S)

    def _why_end(self, handle: ServerGoalHandle) -> str:
        """Return why a goal has to end, '' while it may go on."""
        ended, why = self._ended
        return CANCELLED if handle.is_cancel_requested else (
            why if ended is handle else self._halt)

    def _go_on(self, handle: ServerGoalHandle) -> None:
        """Raise Cancelled if the goal has to end."""
        if why := self._why_end(handle):
            raise Cancelled(why)

    # One goal

    def _reach(self, handle: ServerGoalHandle, accepted: float,
               result: ReachGoal.Result) -> None:
        """Show the loop what is seen since `accepted`, do what it answers, fill the result."""
        request, mode = handle.request, settings.check_request(handle.request)
        config = settings.reach_config(self.params, request)
        self._goal.begin(request, mode)
        self._inputs.begin(accepted)
        self._refusals.clear()
        reach = Reach(self._mpc, config, request.seed, accepted)
        while True:
            self._go_on(handle)
            count = self._sensors.count
            while self._refusals:
                stamp_ns, why = self._refusals.popleft()
                reach.refused(self._arm.answered(stamp_ns), why)
            # what is seen
            seen, missing = self._inputs.look()
            if self._goal.changed(accepted):
                reach = Reach(self._mpc, config, request.seed, accepted)
            # what to do
            answer = reach.step(seen, time.monotonic(), missing)
            result.steps, result.expected_distance = reach.steps, reach.distance
            if isinstance(answer, End):
                if answer.outcome == 'aborted':
                    raise PlanningError(answer.message)
                self._distance.publish(Float64(data=reach.distance))
                result.success = answer.outcome == 'reached'
                far = self._mpc.model.table.apart(reach.pixels, reach.targets[-1].pixels)
                result.message = (f'{answer.message}: objects on average {100 * far:.1f} cm from '
                                  'their goals')
                return
            if isinstance(answer, SelectTargets):
                targets = self._goal.targets(
                    answer.seen, self._mpc, config, lambda: self._go_on(handle))
                reach.set_targets(targets, time.monotonic())
                continue
            # Before sending: the picture that answers may come at once.
            newest_ns, age_ns = self._inputs.newest_picture()
            if isinstance(answer, Command) and self._send(handle, accepted, reach, answer):
                period_ns = int(1e9 * self.params['control_period'])
                reach.sent(
                    newest_ns + 9 * period_ns // 10, time.monotonic(),
                    max(period_ns, age_ns) if answer.seen.received < math.inf else 0)
                result.steps = reach.steps
                self._publish_progress(handle, reach, answer)
            else:
                self._sensors.wait_for_change(0.1, count)

    def _send(self, handle: ServerGoalHandle, accepted: float, reach: Reach,
              command: Command) -> bool:
        """
        Send a command; tell whether it was: not when a sensor is silent or it comes too late.

        :raises TapError: when what was seen while it was planned forbids it.
        """
        self._go_on(handle)
        seen, _ = self._inputs.look()
        if seen is None:  # the clock has jumped; the next step says so
            return False
        if end := reach.interrupted(seen):
            raise PlanningError(end.message)
        answers = command.seen
        age = time.monotonic() - (seen if seen.stamp_ns == answers.stamp_ns else answers).received
        if age > self.params['max_age']:
            self.get_logger().warning(
                f'a command is not sent, as what it answers came {age:.1f} s ago, and max_age is '
                f'{self.params["max_age"]:g} s: the machine is too slow or busy',
                throttle_duration_sec=10.0)
            return False
        return not self._goal.changed(accepted) and self._arm.send(
            handle, command.plan.action, seen.gripper, to_stamp(answers.stamp_ns),
            self._inputs.topics, ages=answers.received < math.inf)

    def _publish_progress(self, handle: ServerGoalHandle, reach: Reach, command: Command) -> None:
        """Publish feedback, the plan and the distance after a command."""
        plan, seen, subgoals = command.plan, command.seen, len(reach.targets) - 1
        self._diagnostics.took(plan.planning_ms, 'plan')
        self._distance.publish(Float64(data=reach.distance))
        if self._overlay.get_subscription_count():
            picture = draw_plan(
                seen.image, self._model.config, plan, seen.gripper,
                reach.targets[command.stage].pixels, self._inputs.sharp(seen))
            self._overlay.publish(encode_image(
                picture, to_stamp(seen.stamp_ns), self._inputs.frame_id))
        stage = 'goal' if command.stage == subgoals else 'subgoal' + (
            f' {command.stage + 1} of {subgoals}' if subgoals > 1 else '')
        handle.publish_feedback(ReachGoal.Feedback(
            step=reach.steps, stage=stage, expected_distance=float(plan.expected_distance),
            planning_ms=float(plan.planning_ms), plan_samples=plan.num_samples))
