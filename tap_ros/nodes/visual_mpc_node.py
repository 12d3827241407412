# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Serves reach_goal: drives planning.reach by what is seen, and sends its commands."""

from collections import deque
from dataclasses import dataclass, field, replace
import sys
import threading
import time
import traceback

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from tap_msgs.action import ReachGoal
from tap_msgs.msg import CommandRefused, Episode, ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import PlanningError, TapError
from tap_ros.nodes.arm import Arm
from tap_ros.nodes.clients import call, CallError
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.image_messages import decode_image, is_empty
from tap_ros.nodes.object_messages import decode_gripper, decode_objects, match_objects
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.planner_setup import (
    check_request,
    declare_parameters,
    load_planner,
)
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subgoal_messages import decode_subgoals
from tap_ros.nodes.topics import LATCHED, STREAM, to_nanoseconds
from tap_ros.planning.hierarchy import choose_sample, targets_by
from tap_ros.planning.reach import Aim, Command, End, Reach, ReachConfig, Seen
from tap_ros.text import escaped

SENSORS = {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects'),
           'joints': (JointState, 'joint_states')}
GOAL = {'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}


class Cancelled(TapError):
    """The goal was cancelled, or the node is ending."""


@dataclass
class Task:
    """A goal in progress, and what it was begun with."""

    handle: object
    accepted: float  # monotonic time
    mode: str = ''
    goal: dict = field(default_factory=dict)  # messages: image, objects
    goal_stamp: int | None = None  # of the goal that came by topic, in ns
    num_subgoals: int = 0
    seen: Seen | None = None  # the newest that was decoded
    messages: dict = field(default_factory=dict)  # that it was decoded from


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
        self._cancelled = None  # the goal that was cancelled last
        self._busy = threading.Lock()  # held from the acceptance of a goal to its end
        self._accepted = 0.0
        self._scene_ns = 0  # stamp of the newest mark that an episode begins
        self._refusals = deque(maxlen=10)
        self._goal = Observations(*GOAL, latched=True)
        self._goal.subscribe(self, GOAL, LATCHED)
        self._sensors = Observations(*SENSORS)
        self.create_subscription(Episode, 'episode', self._on_episode, STREAM)
        self.create_subscription(CommandRefused, 'arm/refused', self._on_refused, STREAM)
        self._sensors.subscribe(self, SENSORS, STREAM)
        self._arm = Arm(self, self.params, self._sensors)
        group = ReentrantCallbackGroup()  # answers and cancels arrive while a goal is executed
        self._predict = self.create_client(
            PredictSubgoal, 'predict_subgoal', callback_group=group)
        self._predictor = Liveness(self, 'predictor_node', callback_group=group)
        self._server = ActionServer(
            self, ReachGoal, 'reach_goal', self._execute, callback_group=group,
            goal_callback=self._on_goal, cancel_callback=self._on_cancel)
        self.get_logger().info(f'ready: {self.params["device"]}, {self.params["weights"]}')

    def close(self):
        """End the goal in progress, and see that the command to stop has left."""
        self._ending = True
        self._arm.end()
        self._sensors.wake()
        self._busy.acquire(timeout=10.0)  # longer than a plan takes
        self._arm.end()
        self._arm.wait_until_sent(1.0)

    # Callbacks

    def _on_goal(self, _):
        if self._ending or not self._busy.acquire(blocking=False):
            self.get_logger().warning(
                'reach_goal rejected: another goal is in progress; cancel it or wait for its end')
            return GoalResponse.REJECT
        self._accepted = time.monotonic()
        return GoalResponse.ACCEPT

    def _on_cancel(self, handle):
        self._cancelled = handle  # who asks its state still finds it executing
        self._arm.end()  # at once: a plan may be in progress
        self._sensors.wake()
        return CancelResponse.ACCEPT

    def _on_episode(self, message):
        if message.event == Episode.START:
            self._scene_ns = to_nanoseconds(message.header.stamp)
            self._sensors.wake()

    def _on_refused(self, message):
        self._refusals.append((to_nanoseconds(message.header.stamp), escaped(message.message)))
        self._sensors.wake()

    def _execute(self, handle):
        """Run a goal to its end; runs in a thread of the executor."""
        result = ReachGoal.Result()
        task = Task(handle, self._accepted)
        self._arm.begin(handle)
        try:
            self._reach(task, result)
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
            result.message = f'internal error: {type(error).__name__}: {escaped(error)}'
            self.get_logger().error(traceback.format_exc())
            handle.abort()
        finally:
            self._arm.end(handle)
            self._busy.release()
        self.get_logger().info(
            f'reach_goal ended after {result.steps} steps: {escaped(result.message, 1000)}')
        return result

    # One goal

    def _reach(self, task, result):
        """Show the loop what is seen, and do what it answers, filling the result."""
        request, handle = task.handle.request, task.handle
        task.mode = check_request(request)
        self._mpc.limit(self.params['max_step_xy'], self.params['max_step_z'])
        self._refusals.clear()
        reach = None
        while True:
            self._go_on(handle)
            count = self._sensors.count
            while self._refusals:
                if reach is not None and reach.refused(*self._refusals.popleft()):
                    result.steps = reach.steps
            topics = self._topics(reach)
            seen, lacking = self._look(task, topics)
            if reach is None:
                if seen is not None and not seen.names:
                    raise PlanningError('objects: none are seen, so there is nothing to push; '
                                        'publish their pixels')
                reach = Reach(self._mpc, self._reach_config(request), request.seed, task.accepted)
            if self._goal_changed(task, reach):
                reach = None
                continue
            answer = reach.step(seen, time.monotonic(), lacking)
            result.expected_distance = reach.distance
            if isinstance(answer, End):
                result.success = answer.outcome == 'reached'
                result.message = answer.message
                if answer.outcome == 'aborted':
                    raise PlanningError(answer.message)
                return
            if isinstance(answer, Aim):
                reach.head_for(self._aim(task, seen), time.monotonic())
            elif isinstance(answer, Command) and self._send(task, answer, topics):
                reach.sent(self._effect_after(task))
                result.steps = reach.steps
                handle.publish_feedback(ReachGoal.Feedback(
                    step=reach.steps, stage=stage_name(answer.stage, task.num_subgoals),
                    expected_distance=float(answer.plan.expected_distance),
                    planning_ms=float(answer.plan.planning_ms)))
            else:
                self._sensors.wait_for_change(0.1, count)

    def _reach_config(self, request):
        """Return the settings of a goal."""
        params = self.params
        return ReachConfig(request.step_budget, params['switch'], params['goal_tolerance'],
                           params['tracking'], params['max_age'], params['image_timeout'])

    def _cancelled_or_ending(self, handle):
        return self._cancelled is handle or self._ending

    def _go_on(self, handle):
        if self._cancelled_or_ending(handle):
            raise Cancelled('cancelled' if self._cancelled is handle else 'the node is ending')

    # What is seen

    def _topics(self, reach):
        """Return the sensors that are needed now: carried objects need to be seen once only."""
        if reach is not None and self.params['tracking'] == 'carried' and reach.aimed:
            return 'image', 'joints'
        return tuple(SENSORS)

    def _look(self, task, topics):
        """
        Return what was seen last since the goal was accepted, as Seen, or None and why.

        :raises TapError: for messages that cannot be used.
        """
        moment = self._sensors.moment(topics, since=task.accepted)
        if moment is None:
            return None, self._lacking(topics, task.accepted)
        times = {'received': moment.received, 'scene_ns': self._scene_ns,
                 'jumps': self._sensors.jumps}
        if task.seen is not None and (task.seen.stamp_ns, task.seen.jumps) == (
                moment.stamp_ns, self._sensors.jumps):
            task.seen = replace(task.seen, **times)
            return task.seen, ''
        size = self._mpc.image_size
        names, pixels = task.seen.names if task.seen else (), None
        if 'objects' in topics:
            names, pixels = decode_objects(moment.messages['objects'], 'objects', size)
            if task.seen is not None and set(names) == set(task.seen.names):
                pixels = match_objects(
                    task.seen.names, names, pixels, 'the first objects', 'objects')
                names = task.seen.names
        image = decode_image(moment.messages['image'], 'camera/image_raw', size)
        gripper = decode_gripper(moment.messages['joints'])
        task.seen = Seen(image, gripper, names, pixels, moment.stamp_ns, **times)
        task.messages = moment.messages
        return task.seen, ''

    def _lacking(self, topics, since):
        """Say why nothing can be seen."""
        missing = self._sensors.missing(topics)
        if missing:
            return f'nothing has come on {self._names(missing)}'
        now = time.monotonic()
        ages = self._sensors.ages(topics, now)
        silent = [topic for topic in topics if ages[topic] > min(
            now - since, self.params['max_silence'])]
        if silent:
            return f'nothing new has come on {self._names(silent)}'
        return f'no new messages of the same stamp on {self._names(topics)}'

    def _names(self, topics):
        return ', '.join(self.resolve_topic_name(SENSORS[topic][1]) for topic in topics)

    # Where to go

    def _aim(self, task, seen):
        """Return the Targets of a goal, asking for subgoals if it is to go by any."""
        request = task.handle.request
        self._find_goal(task)
        names, pixels = decode_objects(task.goal['objects'], 'goal_objects', self._mpc.image_size)
        goal_pixels = match_objects(seen.names, names, pixels, 'objects', 'goal_objects')
        subgoals = []
        if task.mode == 'subgoal':
            subgoals = choose_sample(
                self._mpc, seen.image, seen.gripper, seen.pixels, goal_pixels,
                self._ask_for_subgoals(task, seen), request.seed,
                lambda: self._go_on(task.handle))
        task.num_subgoals = len(subgoals)
        return targets_by(subgoals, goal_pixels)

    def _needed(self, task):
        """Return what of the goal has to come by topic."""
        request = task.handle.request
        return [topic for topic, empty in (
            ('image', task.mode == 'subgoal' and is_empty(request.goal_image)),
            ('objects', not request.goal_objects.objects)) if empty]

    def _find_goal(self, task):
        """Take the goal's picture and objects from the request, or from their topics."""
        request, needed = task.handle.request, self._needed(task)
        task.goal = {'image': request.goal_image, 'objects': request.goal_objects}
        if not needed:
            return
        found = self._goal.wait(needed, self.params['image_timeout'],
                                give_up=lambda: self._cancelled_or_ending(task.handle))
        self._go_on(task.handle)
        if found is None:
            missing = self._goal.missing(needed) or needed
            names = [self.resolve_topic_name(GOAL[topic][1]) for topic in missing]
            raise PlanningError(
                f'goal: nothing has come on {", ".join(names)}; publish there (the simulator does '
                'at sim/reset), or send goal_image and goal_objects along')
        task.goal.update({topic: found[topic] for topic in needed})
        task.goal_stamp = to_nanoseconds(found[needed[0]].header.stamp)

    def _goal_changed(self, task, reach):
        """
        Tell whether to aim again, at a goal that had come when this one was accepted.

        :raises PlanningError: if another one has come since then.
        """
        if task.goal_stamp is None:
            return False
        needed = self._needed(task)
        newest = self._goal.moment(needed)
        if newest is None or newest.stamp_ns == task.goal_stamp:
            return False
        if newest.received > task.accepted or reach.steps:
            names = ', '.join(self.resolve_topic_name(GOAL[topic][1]) for topic in needed)
            raise PlanningError(f'the scene has changed: a new goal has come on {names}')
        task.goal_stamp = None
        return True

    def _ask_for_subgoals(self, task, seen):
        """Return the Subgoals of all samples, their objects in the order of those seen."""
        wanted = task.handle.request
        request = PredictSubgoal.Request(
            start=task.messages['image'], goal=task.goal['image'],
            start_objects=task.messages['objects'], goal_objects=task.goal['objects'],
            num_samples=wanted.num_samples, recursion_depth=wanted.recursion_depth,
            seed=wanted.seed)
        try:
            response = call(
                self._predict, request, self.params['predictor_timeout'],
                lambda: self._cancelled_or_ending(task.handle), self._predictor)
        except CallError:
            self._go_on(task.handle)
            raise
        if not response.success:
            raise PlanningError(f'service {self._predict.service_name}: {response.message}')
        return decode_subgoals(response, seen.names, self._mpc.image_size)

    # Commands

    def _send(self, task, command, topics):
        """Send a command, unless the goal has ended or the sensors are silent; tell whether."""
        self._go_on(task.handle)
        return self._arm.send(task.handle, command.plan.action,
                              task.messages['image'].header.stamp, topics)

    def _effect_after(self, task):
        """
        Return from which stamp on pictures show what was just sent, in ns.

        Later than the newest image that had already come, and with one control period between.
        """
        newest = (self._sensors.newest('image') or task.messages)['image']
        return to_nanoseconds(newest.header.stamp) + int(0.9e9 * self.params['control_period'])


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
