# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves reach_goal: asks for subgoals, plans with VisualMPC, sends one command per image."""

import sys
import threading
import time
import traceback

from geometry_msgs.msg import TwistStamped
import numpy as np
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import PlanningError, TapError
from tap_ros.nodes.clients import call, CallError
from tap_ros.nodes.image_messages import decode_image, is_empty
from tap_ros.nodes.object_messages import decode_gripper, decode_objects, match_objects
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.planner_setup import (
    check_request,
    declare_parameters,
    default_budget,
    load_planner,
)
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subgoal_messages import decode_subgoals
from tap_ros.nodes.topics import LATCHED, STREAM, to_nanoseconds
from tap_ros.planning.hierarchy import choose_sample, Itinerary, targets_by
from tap_ros.planning.tracking import ObjectTracker

SENSORS = {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects'),
           'joints': (JointState, 'joint_states')}
LATE_PERIODS = 4  # control periods without a picture until the arm is stopped
GOAL = {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}


class Cancelled(TapError):
    """The goal was cancelled, or the node is ending."""


class VisualMpcNode(Node):
    """
    Executes one goal at a time, in a thread of the executor that callbacks do not need.

    A second goal is rejected meanwhile. Whatever the way a goal ends, the last command is zero.
    """

    def __init__(self):
        super().__init__('visual_mpc_node')
        self.params = declare_parameters(self)
        self._mpc = load_planner(self.params)
        self._ending = False
        self._sending = threading.Lock()  # no command may follow the stop of a cancel
        self._cancelled = None  # the goal that was cancelled last
        self._busy = threading.Lock()  # held from the acceptance of a goal to its end
        self._sensors = Observations(*SENSORS)
        self._sensors.subscribe(self, SENSORS, STREAM)
        self._goal = Observations(*GOAL)
        self._goal.subscribe(self, GOAL, LATCHED)
        self._gripper = self.create_publisher(Float64, 'gripper/command', STREAM)
        self._twist = self.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
        group = ReentrantCallbackGroup()  # answers and cancels arrive while a goal is executed
        self._predict = self.create_client(
            PredictSubgoal, 'predict_subgoal', callback_group=group)
        self._server = ActionServer(
            self, ReachGoal, 'reach_goal', self._execute, callback_group=group,
            goal_callback=self._on_goal, cancel_callback=self._on_cancel)
        self.get_logger().info(f'ready: {self.params["device"]}, {self.params["weights"]}')

    def close(self):
        """End the goal in progress, and see that the command to stop has left."""
        with self._sending:
            self._ending = True
            self._stop()
        self._sensors.wake()
        self._busy.acquire(timeout=10.0)  # longer than a plan takes
        self._stop()
        self._twist.wait_for_all_acked(Duration(seconds=1))

    # The action

    def _on_goal(self, _):
        if self._ending or not self._busy.acquire(blocking=False):
            self.get_logger().warning(
                'reach_goal rejected: another goal is in progress; cancel it or wait for its end')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, handle):
        with self._sending:
            self._cancelled = handle  # who asks its state still finds it executing
            self._stop()  # at once: a plan may be in progress
        self._sensors.wake()
        return CancelResponse.ACCEPT

    def _execute(self, handle):
        """Run a goal to its end; runs in a thread of the executor."""
        result = ReachGoal.Result()
        try:
            self._reach(handle, result)
            handle.succeed()
        except Cancelled as error:
            result.message = str(error)
            if self._cancelled is handle and cancel_is_known(handle):
                handle.canceled()
            else:
                handle.abort()
        except TapError as error:
            result.message = str(error)
            handle.abort()
        except Exception as error:
            result.message = f'{type(error).__name__}: {error}'
            self.get_logger().error(traceback.format_exc())
            handle.abort()
        finally:
            self._stop()
            self._busy.release()
        self.get_logger().info(f'reach_goal ended after {result.steps} steps: {result.message}')
        return result

    def _reach(self, handle, result):
        """Plan and act until the goal is reached or the budget spent, filling the result."""
        request = handle.request
        mode = check_request(request)

        def cancelled():
            return self._cancelled is handle or self._ending

        def go_on():
            if cancelled():
                raise Cancelled('cancelled')

        goal, goal_names, goal_pixels = self._find_goal(request, mode)
        seen = self._observe(-1, cancelled)
        names, _ = decode_objects(seen['objects'], 'objects')
        if not names:
            raise PlanningError(
                'objects: none are seen, so there is nothing to push; publish their pixels')
        goal_pixels = match_objects(names, goal_names, goal_pixels, 'objects', 'goal_objects')
        budget = request.step_budget or default_budget(len(names))
        tolerance = self.params['goal_tolerance']
        carried = self.params['tracking'] == 'carried'
        self._mpc.limit(self.params['max_step_xy'], self.params['max_step_z'])
        scene, subgoals = self._decode(seen, names), []
        if mode == 'subgoal':
            found = self._ask_for_subgoals(seen, goal, names, request, cancelled)
            subgoals = choose_sample(
                self._mpc, *scene, goal_pixels, found, request.seed, go_on)
            # The newest: asking and choosing take time. With carried, objects may come once only.
            seen = self._observe(-1, cancelled, ('image', 'joints') if carried else SENSORS)
            scene = (*self._decode_arm(seen), scene[2]) if carried else self._decode(seen, names)
        targets = targets_by(subgoals, goal_pixels)
        itinerary = Itinerary(targets, budget, self.params['switch'], tolerance)
        tracker = ObjectTracker(self._mpc.model, *scene) if carried else None
        self._mpc.reset(request.seed)
        while True:
            image, gripper, pixels = scene
            distance = result.expected_distance = targets[-1].distance(pixels)
            result.success = distance <= tolerance
            if result.success or result.steps >= budget:
                break
            target = itinerary.target(result.steps, pixels)
            plan = self._mpc.act(image, gripper, pixels, **target.goal(pixels))
            go_on()
            sent_ns = self._send(plan.action, seen['image'], handle)
            result.steps += 1
            handle.publish_feedback(ReachGoal.Feedback(
                step=result.steps, stage=stage_name(len(itinerary.switches), len(subgoals)),
                expected_distance=float(plan.expected_distance),
                planning_ms=float(plan.planning_ms)))
            if tracker is None:
                seen = self._observe(sent_ns, cancelled)
                scene = self._decode(seen, names)
            else:
                seen = self._observe(sent_ns, cancelled, ('image', 'joints'))
                after = self._decode_arm(seen)
                scene = (*after, tracker.update(image, gripper, plan.action, *after))
        result.message = (
            f'{distance:.1f} px from the goal, '
            + ('reached' if result.success else f'step budget of {budget} spent'))

    # What a goal needs

    def _find_goal(self, request, mode):
        """Return the goal's image and objects, and the latter's names and pixels."""
        needed = [topic for topic, empty in (
            ('image', mode == 'subgoal' and is_empty(request.goal_image)),
            ('objects', not request.goal_objects.objects)) if empty]
        found = {}
        if needed:
            found = self._goal.wait(needed, self.params['image_timeout'])
        if found is None:
            missing = self._goal.missing(needed) or needed
            names = [self.resolve_topic_name(GOAL[topic][1]) for topic in missing]
            raise PlanningError(
                f'goal: nothing has come on {", ".join(names)}; publish there (the simulator does '
                'at sim/reset), or send goal_image and goal_objects along')
        goal = {'image': request.goal_image, 'objects': request.goal_objects}
        goal.update({topic: found[topic] for topic in needed})
        return goal, *decode_objects(goal['objects'], 'goal_objects')

    def _observe(self, after_ns, cancelled, topics=SENSORS):
        """
        Wait for messages of one moment after `after_ns`.

        When they are late the arm is stopped at once, long before they are given up: a driver may
        go on with the last velocity.
        """
        timeout = self.params['image_timeout']
        soon = min(timeout, LATE_PERIODS * self.params['control_period'])
        seen = self._sensors.wait(topics, soon, after_ns, cancelled)
        if seen is None and not cancelled():
            self._stop()
            seen = self._sensors.wait(topics, timeout - soon, after_ns, cancelled)
        if cancelled():
            raise Cancelled('cancelled')
        if seen is None:
            missing = self._sensors.missing(topics)
            names = [self.resolve_topic_name(SENSORS[topic][1]) for topic in missing or topics]
            raise PlanningError(
                f'no observation for {timeout:g} s: '
                + ('nothing has come on ' if missing else 'no new messages of the same stamp on ')
                + ', '.join(names))
        return seen

    def _decode(self, seen, names):
        """Return picture, gripper (4,) and pixels (K, 2) of what is seen, ordered like `names`."""
        pixels = match_objects(
            names, *decode_objects(seen['objects'], 'objects'), 'the first objects', 'objects')
        return *self._decode_arm(seen), pixels

    def _decode_arm(self, seen):
        """Return picture and gripper (4,)."""
        image = decode_image(seen['image'], 'camera/image_raw', self._mpc.image_size)
        return image, decode_gripper(seen['joints'])

    def _ask_for_subgoals(self, seen, goal, names, wanted, cancelled):
        """Return the Subgoals of all samples, their objects in the order of `names`."""
        request = PredictSubgoal.Request(
            start=seen['image'], goal=goal['image'], start_objects=seen['objects'],
            goal_objects=goal['objects'], num_samples=wanted.num_samples,
            recursion_depth=wanted.recursion_depth, seed=wanted.seed)
        try:
            response = call(self._predict, request, self.params['predictor_timeout'], cancelled)
        except CallError as error:
            if cancelled():
                raise Cancelled('cancelled') from error
            raise
        if not response.success:
            raise PlanningError(f'service {self._predict.service_name}: {response.message}')
        return decode_subgoals(response, names, self._mpc.image_size)

    # Commands

    def _send(self, action, image, handle):
        """
        Send one command within the limits, stamped like the image message that it answers.

        Nothing is sent for a goal that was cancelled.

        :return: images count from this stamp on, in ns: later than the newest image that had
            already come, and with one control period between.
        """
        if not np.isfinite(action).all():
            raise PlanningError(f'the planner chose {action}; expected finite numbers')
        # The planner keeps within them already.
        limit = np.array([self.params['max_step_xy']] * 2 + [self.params['max_step_z']])
        move = np.clip(np.asarray(action[:3], np.float64), -limit, limit)
        message = TwistStamped()
        message.header.stamp = (self.get_clock().now().to_msg() if self.params['stamp_with_now']
                                else image.header.stamp)
        message.header.frame_id = self.params['command_frame']
        linear = message.twist.linear
        linear.x, linear.y, linear.z = (self.params['twist_scale'] * move).tolist()
        newest = (self._sensors.newest('image') or {'image': image})['image']
        with self._sending:
            if self._cancelled is handle or self._ending:
                raise Cancelled('cancelled')
            self._gripper.publish(Float64(data=float(np.clip(action[3], 0, 1))))
            self._twist.publish(message)
        return to_nanoseconds(newest.header.stamp) + int(0.9e9 * self.params['control_period'])

    def _stop(self):
        """Send a zero command; it has no stamp, since it answers no image."""
        self._twist.publish(TwistStamped())


def cancel_is_known(handle, seconds=1.0):
    """Wait until rclpy knows that a goal is cancelled, which is after _on_cancel has returned."""
    deadline = time.monotonic() + seconds
    while not handle.is_cancel_requested and time.monotonic() < deadline:
        time.sleep(0.01)
    return handle.is_cancel_requested


def stage_name(index, num_subgoals):
    """Return what feedback calls the target of this index; after the subgoals comes the goal."""
    if index == num_subgoals:
        return 'goal'
    return 'subgoal' if num_subgoals == 1 else f'subgoal {index + 1} of {num_subgoals}'


def main(args=None):
    """Run the node; the answer is the exit code of the process."""
    return run_node(VisualMpcNode, 'visual_mpc_node', args, num_threads=4)


if __name__ == '__main__':
    sys.exit(main())
