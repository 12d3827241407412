# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves reach_goal: drives planning.reach by what is seen, and sends its commands."""

from collections import deque
from collections.abc import Collection, Mapping
from contextlib import suppress
import math
from pathlib import Path
import sys
import threading
import time
import traceback
from typing import Any, cast, TYPE_CHECKING

import numpy as np
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from tap_msgs.action import ReachGoal
from tap_msgs.msg import CommandRefused, ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.contract import WORLD_FRAME
from tap_ros.errors import PlanningError, TapError
from tap_ros.messages.images import is_empty
from tap_ros.messages.objects import match_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import decode_subgoals
from tap_ros.nodes.clients import call, CallError
from tap_ros.nodes.diagnostics import Diagnostics
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.lifecycle import ManagedNode
from tap_ros.nodes.planner.arm import Arm
from tap_ros.nodes.planner.goal_source import goal_topics, GoalSource, needed_topics
from tap_ros.nodes.planner.plan_markers import encode_plan
from tap_ros.nodes.planner.planner_inputs import sensor_topics, Sight
from tap_ros.nodes.planner.settings import (
    check_request,
    declare_parameters,
    load_planner,
    unlike_training,
)
from tap_ros.nodes.ros_messages import encode_image, encode_objects
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subscriptions import subscribe
from tap_ros.nodes.topics import SERVICE_QOS, STREAM, to_stamp
from tap_ros.planning.action_sequences import Limits
from tap_ros.planning.forward_model import ForwardModel
from tap_ros.planning.hierarchy import choose_sample, targets_by
from tap_ros.planning.mpc_inputs import Scene
from tap_ros.planning.plan_picture import draw_plan
from tap_ros.planning.reach import Aim, Command, End, Reach, ReachConfig
from tap_ros.text import escaped
from visualization_msgs.msg import MarkerArray

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle
    from tap_ros.messages.subgoals import Subgoal
    from tap_ros.planning.hierarchy import Target
    from tap_ros.planning.reach import Seen
    from tap_ros.planning.visual_mpc import VisualMPC

ENDING = 'the node is ending'
STALE_S = 2.0  # diagnostics call an input stale that has been silent for so long


class Cancelled(TapError):
    """The goal was cancelled, or the node is ending or not active any more."""


class VisualMpcNode(ManagedNode):
    """
    Executes one goal at a time, in a thread of the executor that callbacks do not need.

    A second goal is rejected meanwhile. Whatever the way a goal ends, the last command is zero.
    While the node is not active, goals are aborted with the reason.
    """

    reloaded = 'weights',
    _mpc: 'VisualMPC'  # while configured

    def __init__(self) -> None:
        super().__init__('visual_mpc_node')
        self.params = declare_parameters(self)
        self._halt = ''  # why no goal may go on
        self._cancelled: ServerGoalHandle | None = None  # the goal that was cancelled last
        self._busy = threading.Lock()  # held while a goal is executed
        self._refusals: deque[tuple[int, str]] = deque(maxlen=10)
        self.autostart('configure')
        robot_mask = self.params['robot_mask']
        self._diagnostics = Diagnostics(self, {
            **dict.fromkeys((name for _, name in sensor_topics(self.params).values()), STALE_S),
            **dict.fromkeys((name for _, name in goal_topics(robot_mask).values()), math.inf)},
            idle=self.why_not)
        heard = self._diagnostics.received
        self._goal = GoalSource(self, robot_mask, heard)
        self._sight = Sight(self, self.params, lambda: self._model.camera_crop, heard)
        self._sensors = self._sight.sensors
        self._arm = Arm(self, self.params, self._sensors)
        subscribe(self, CommandRefused, 'arm/refused', self._on_refused, STREAM)
        group = ReentrantCallbackGroup()  # answers and cancels arrive while a goal is executed
        self._predict = self.create_client(
            PredictSubgoal, 'predict_subgoal', qos_profile=SERVICE_QOS, callback_group=group)
        self._predictor = Liveness(self, 'predictor_node', callback_group=group)
        self._markers = self.create_publisher(MarkerArray, 'plan/markers', STREAM)
        self._overlay = self.create_publisher(Image, 'plan/overlay', STREAM)
        self._distance = self.create_publisher(Float64, 'plan/distance', STREAM)
        self._server = ActionServer(
            self, ReachGoal, 'reach_goal', self._execute, callback_group=group,
            goal_callback=self._on_goal, cancel_callback=self._on_cancel)
        self.autostart('activate')

    def close(self) -> None:
        """End the goal in progress, and see that the command to stop has left."""
        self.active = False
        self._end_goal(ENDING)
        self._arm.close(1.0)

    # Weights

    def load(self, changed: Mapping[str, Any]) -> 'VisualMPC':
        """Load weights; return what plans with them."""
        self._check_idle()
        return load_planner(self.params, changed.get('weights', self.params['weights']))

    def use(self, loaded: 'VisualMPC') -> None:
        """Plan with other weights."""
        self._mpc = loaded
        unlike = unlike_training(loaded, self.params['robot_mask'])
        if unlike:
            self.get_logger().warning(unlike)

    def unload(self) -> None:
        """Let the weights go."""
        self._check_idle()
        with suppress(AttributeError):  # where there are none
            del self._mpc

    def described(self) -> str:
        """Name the device and the file."""
        return f'{self.params["device"]}, {self.params["weights"]}'

    def files(self, changed: Mapping[str, Any]) -> list[Path]:
        """Return the file of the weights."""
        return [Path(changed.get('weights', self.params['weights']))]

    def resume(self) -> None:
        """Serve goals again, once the last one has ended."""
        self._check_idle()
        if self._halt == ENDING:
            raise PlanningError(ENDING)
        self._halt = ''

    def _check_idle(self) -> None:
        """Raise PlanningError while the last goal has not ended: a plan may take its time."""
        if self._busy.locked():
            raise PlanningError('the last goal has not ended yet; try again')

    def pause(self) -> None:
        """Stop the arm at once, and let the goal in progress end."""
        self._end_goal('the node was deactivated')

    def _end_goal(self, reason: str) -> None:
        """Let no goal go on; wait for the one in progress."""
        self._halt = reason
        self._arm.end()
        self._sensors.wake()
        if self._busy.acquire(timeout=10.0):  # longer than a plan takes
            self._busy.release()

    @property
    def _model(self) -> ForwardModel:
        """Return the forward model of the weights."""
        return cast(ForwardModel, self._mpc.model)  # as load_planner has loaded it

    # Callbacks

    def _on_goal(self, _: ReachGoal.Goal) -> GoalResponse:
        if self._busy.locked():
            self.get_logger().warning(
                'reach_goal rejected: another goal is in progress; cancel it or wait for its end')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, handle: 'ServerGoalHandle') -> CancelResponse:
        self._cancelled = handle  # who asks its state still finds it executing
        self._arm.end(handle)  # at once: a plan may be in progress
        self._sensors.wake()
        return CancelResponse.ACCEPT

    def _on_refused(self, message: CommandRefused) -> None:
        self._refusals.append((to_nanoseconds(message.header.stamp), escaped(message.message)))
        self._sensors.wake()

    def _execute(self, handle: 'ServerGoalHandle') -> ReachGoal.Result:
        """Run a goal to its end; runs in a thread of the executor."""
        result = ReachGoal.Result()
        if not self.active:
            result.message = self.why_not()
            self.get_logger().warning(f'reach_goal refused: {result.message}')
            handle.abort()
            return result
        if not self._busy.acquire(blocking=False):  # two were accepted at the same time
            result.message = 'another goal is in progress; cancel it or wait for its end'
            handle.abort()
            return result
        try:
            self._arm.begin(handle)
            self._go_on(handle)
            self._reach(handle, time.monotonic(), result)
            handle.succeed()
        except Cancelled as error:
            result.message = str(error)
            if self._is_cancelled(handle) and cancel_is_known(handle):
                handle.canceled()
            else:
                handle.abort()
        except TapError as error:
            result.message = str(error)
            self._diagnostics.error(error)
            handle.abort()
        except Exception as error:
            self._diagnostics.error(error)
            result.message = f'internal error: {type(error).__name__}: {escaped(error)}'
            self.get_logger().error(traceback.format_exc())
            handle.abort()
        finally:
            try:
                self._arm.end(handle)
            finally:
                self._busy.release()
        self.get_logger().info(
            f'reach_goal ended after {result.steps} steps: {escaped(result.message, 1000)}')
        return result

    # One goal

    def _reach(self, handle: 'ServerGoalHandle', accepted: float,
               result: ReachGoal.Result) -> None:
        """Show the loop what is seen since `accepted`, do what it answers, fill the result."""
        request = handle.request
        mode = check_request(request)
        self._goal.begin(needed_topics(request, mode))
        self._sight.begin(accepted)
        self._refusals.clear()
        config = self._config(request)
        reach = Reach(self._mpc, config, request.seed, accepted)
        while True:
            self._go_on(handle)
            count = self._sensors.count
            while self._refusals:
                reach.refused(*self._refusals.popleft())
            # Objects that are carried need to be seen once only.
            topics = self._sight.topics(objects=not (config.follower and reach.aimed))
            seen, lacking = self._sight.look(topics)
            if self._goal.changed(accepted):
                reach = Reach(self._mpc, config, request.seed, accepted)
            answer = reach.step(seen, time.monotonic(), lacking)
            result.steps, result.expected_distance = reach.steps, reach.distance
            if isinstance(answer, End):
                if answer.outcome == 'aborted':
                    raise PlanningError(answer.message)
                self._distance.publish(Float64(data=reach.distance))
                result.success, result.message = answer.outcome == 'reached', answer.message
                return
            if isinstance(answer, Aim):
                reach.head_for(self._aim(handle, mode, answer.seen, config.limits),
                               time.monotonic())
                continue
            # Before sending: the picture that answers may come at once.
            newest_ns = self._sight.newest_stamp()
            if isinstance(answer, Command) and self._send(handle, accepted, reach, answer, topics):
                reach.sent(newest_ns + int(0.9e9 * self.params['control_period']),
                           time.monotonic())
                result.steps = reach.steps
                self._diagnostics.took(answer.plan.planning_ms, 'plan')
                self._distance.publish(Float64(data=reach.distance))
                self._show(answer, reach.targets[answer.stage])
                handle.publish_feedback(ReachGoal.Feedback(
                    step=reach.steps, stage=stage_name(answer.stage, len(reach.targets) - 1),
                    expected_distance=float(answer.plan.expected_distance),
                    planning_ms=float(answer.plan.planning_ms)))
            else:
                self._sensors.wait_for_change(0.1, count)

    def _show(self, command: Command, target: 'Target') -> None:
        """Publish a plan for those who look at it, if there are any."""
        plan, seen = command.plan, command.seen
        stamp = to_stamp(seen.stamp_ns)
        if self._markers.get_subscription_count():
            self._markers.publish(encode_plan(plan, seen.gripper, stamp, WORLD_FRAME))
        if self._overlay.get_subscription_count():
            picture = draw_plan(seen.image, self._model.config, plan, seen.gripper, target.pixels)
            frame_id = self._sight.messages['image'].header.frame_id
            self._overlay.publish(encode_image(picture, stamp, frame_id))

    def _config(self, request: ReachGoal.Goal) -> ReachConfig:
        """Return the settings of a goal."""
        params = self.params
        follower = self._model if params['tracking'] == 'carried' else None
        limits = Limits(params['max_step_xy'], params['max_step_z'])
        return ReachConfig(request.step_budget, params['switch'], params['goal_tolerance'],
                           follower, limits, params['max_age'], params['image_timeout'],
                           rounds=params['subgoal_rounds'])

    def _is_cancelled(self, handle: 'ServerGoalHandle') -> bool:
        return self._cancelled is handle or handle.is_cancel_requested

    def _has_to_end(self, handle: 'ServerGoalHandle') -> bool:
        return self._is_cancelled(handle) or bool(self._halt)

    def _go_on(self, handle: 'ServerGoalHandle') -> None:
        if self._has_to_end(handle):
            raise Cancelled('cancelled' if self._is_cancelled(handle) else self._halt)

    # Where to go

    def _aim(self, handle: 'ServerGoalHandle', mode: str, seen: 'Seen',
             limits: Limits) -> list['Target']:
        """Return the Targets of a goal, asking for subgoals if it is to go by any."""
        if not seen.names or seen.pixels is None:
            raise PlanningError('objects: none are seen, so there is nothing to push; publish '
                                'their pixels')
        request = handle.request
        goal = self._goal.take(request, self.params['image_timeout'],
                               lambda: self._has_to_end(handle))
        self._go_on(handle)
        names, pixels = self._sight.decode_positions(
            goal['objects'], 'goal_objects', None if is_empty(goal['image']) else goal['image'])
        goal_pixels = match_objects(seen.names, names, pixels, 'objects', 'goal_objects')
        subgoals = []
        if mode == 'subgoal':
            found = self._ask_for_subgoals(handle, goal, seen, goal_pixels)
            subgoals = choose_sample(
                self._mpc, Scene(seen.image, seen.gripper, seen.pixels), goal_pixels, found,
                request.seed, limits, lambda: self._go_on(handle))
        return targets_by(subgoals, goal_pixels)

    def _ask_for_subgoals(self, handle: 'ServerGoalHandle', goal: dict[str, Any], seen: 'Seen',
                          goal_pixels: np.ndarray) -> list['Subgoal']:
        """
        Return the Subgoals of all samples, their objects in the order in which they are seen.

        Pictures are sent as the planner sees them, cut and scaled, so that the maps of the answer
        are in its pixels whatever the predictor makes of a camera's pictures.
        """
        wanted, picture = handle.request, goal['image']
        if 'mask' in goal:
            picture = self._sight.robot.fill_goal(picture, goal['mask'])
        stamp, frame_id = to_stamp(seen.stamp_ns), self._sight.messages['image'].header.frame_id
        assert seen.pixels is not None
        objects, goal_objects = (encode_objects(
            seen.names, pixels, np.full((len(pixels), 7), np.nan), stamp, frame_id,
            ObjectStates.SOURCE_TRACKED) for pixels in (seen.pixels, goal_pixels))
        request = PredictSubgoal.Request(
            start=encode_image(seen.image, stamp, frame_id),
            goal=encode_image(self._sight.cut(picture, 'goal'), stamp, frame_id),
            start_objects=objects, goal_objects=goal_objects,
            num_samples=wanted.num_samples, recursion_depth=wanted.recursion_depth,
            seed=wanted.seed)
        begin = time.perf_counter()
        try:
            response = call(
                self._predict, request, self.params['predictor_timeout'],
                lambda: self._has_to_end(handle), self._predictor)
        except CallError:
            self._go_on(handle)
            raise
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'predict_subgoal')
        if not response.success:
            raise PlanningError(f'service {self._predict.service_name}: '
                                f'{escaped(response.message, 1000)}')
        return decode_subgoals(response, seen.names, self._mpc.image_size)

    def _send(self, handle: 'ServerGoalHandle', accepted: float, reach: Reach, command: Command,
              topics: Collection[str]) -> bool:
        """
        Send a command; tell whether it was: not when a sensor is silent or it comes too late.

        :raises TapError: when what was seen while it was planned forbids it.
        """
        self._go_on(handle)
        seen, _ = self._sight.look(topics)
        if seen is None:  # the clock has jumped; the next step says so
            return False
        end = reach.interrupted(seen)
        if end:
            raise PlanningError(end.message)
        age = time.monotonic() - (
            seen if seen.stamp_ns == command.seen.stamp_ns else command.seen).received
        if age > self.params['max_age'] or self._goal.changed(accepted):
            return False
        return self._arm.send(
            handle, command.plan.action, to_stamp(command.seen.stamp_ns), topics)


def cancel_is_known(handle: 'ServerGoalHandle', seconds: float = 1.0) -> bool:
    """Wait until rclpy knows that a goal is cancelled, which is after _on_cancel has returned."""
    deadline = time.monotonic() + seconds
    while not handle.is_cancel_requested and time.monotonic() < deadline:
        time.sleep(0.01)
    return handle.is_cancel_requested


def stage_name(index: int, num_subgoals: int) -> str:
    """Return what feedback calls the target of this index; after the subgoals comes the goal."""
    if index == num_subgoals:
        return 'goal'
    return 'subgoal' if num_subgoals == 1 else f'subgoal {index + 1} of {num_subgoals}'


def main(args: list[str] | None = None) -> int:
    """Run the node; the answer is the exit code of the process."""
    return run_node(VisualMpcNode, 'visual_mpc_node', args, num_threads=4)


if __name__ == '__main__':
    sys.exit(main())
