# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands of visual_mpc_node to the arm, and the watch that stops it."""

from collections.abc import Collection
import math
import threading
import time

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped
import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
from tap_ros.base.errors import PlanningError
from tap_ros.base.text import escaped
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import CONTROL_PERIOD
from tap_ros.nodes.planner.settings import check_period, step_limits
from tap_ros.ros.observations import Observations
from tap_ros.ros.parameters import Parameters
from tap_ros.ros.topics import LATCHED, STREAM

WATCH_S = 0.02  # s between two checks whether the arm has to be stopped
STOOD_S = 2.0  # s; a longer gap between checks proves that the process or machine stood still
REPEAT_S = 0.2  # s after which a stop is repeated, while a goal is in progress


class ArmCommander:
    """
    Commands for one goal at a time; thread-safe.

    While a goal is in progress, a thread of its own sends zero unless the last command and all
    watched sensors are younger than max_silence, whatever keeps the planner or the executor busy.

    :param params: Parameters of the node.
    :param sensors: Observations of the watched sensors.
    """

    def __init__(self, node: Node, params: Parameters, sensors: Observations) -> None:
        self._node, self._params, self._sensors = node, params, sensors
        self._lock = threading.Condition()  # no command may follow the end of a goal
        self._goal: object = None
        self._topics: tuple[str, ...] = ()
        self._moved_at = self._stopped_at = -math.inf  # monotonic time
        self._stamps = 0, 0  # ns, of the last command and of the image that it answers
        self._ticked_at, self._stood_s = now_awake(), 0.0
        self._gripper = node.create_publisher(Float64, 'gripper/command', STREAM)
        self._twist = node.create_publisher(TwistStamped, 'arm/delta_twist_cmds', STREAM)
        for name in ('command_timeout', 'control_period'):
            node.create_publisher(Float64, f'arm/{name}', LATCHED).publish(
                Float64(data=params[name]))
        self._period = params['control_period']  # as the arm says, or as it is told
        self._echoed = False  # what this node itself says has come, before or after the arm's
        node.create_subscription(Float64, CONTROL_PERIOD.name, self._on_period, QoSProfile(
            depth=10, durability=LATCHED.durability))  # else one hides another that came before
        self._closed = False
        self._thread = threading.Thread(target=self._watch, name='arm watch', daemon=True)
        self._thread.start()

    def begin(self, goal: object) -> None:
        """
        Let this goal (any object), and no other, move the arm from now on.

        :raises ConfigError: when the arm takes another time for a command than is planned with.
        """
        check_period(self._params, self._period)
        with self._lock:
            if self._closed:
                return
            self._goal, self._topics = goal, ()
            self._moved_at = -math.inf
            self._ticked_at, self._stood_s = now_awake(), 0.0
            self._stop()
            self._lock.notify()

    def end(self, goal: object = None) -> None:
        """
        Stop the arm; the goal may not move it any more.

        :param goal: as given to begin; None: any.
        """
        with self._lock:
            if goal is None or self._goal is goal:
                self._goal = None
            self._stop()

    def send(self, goal: object, action: np.ndarray, gripper: np.ndarray, stamp: Time,
             topics: Collection[str], ages: bool = True) -> bool:
        """
        Send one command, clipped to the limits and to the workspace.

        :param goal: as given to begin.
        :param action: (4,) metres moved in one control period, and gripper opening 0..1. What is
            sent is the velocity, m/s.
        :param gripper: (4,) where it was seen last, m.
        :param stamp: builtin_interfaces/Time of the image that it answers.
        :param topics: sensors that the arm depends on until the next command.
        :param ages: whether what they tell gets old; not where time waits for commands.
        :return: whether it was sent; not when the goal has ended or a sensor is silent.
        :raises PlanningError: for numbers that are not finite, and after this process stood still:
            messages received then may be old.
        :raises ConfigError: when the arm takes another time for a command by now.
        """
        check_period(self._params, self._period)
        if not np.isfinite(action).all():
            raise PlanningError(f'the planner chose {action}; expected finite numbers')
        params = self._params
        # The planner keeps within them already.
        limits = step_limits(params)
        limit = np.array([limits.move, limits.move, limits.climb])
        move = np.clip(np.asarray(action[:3], np.float64), -limit, limit)
        move[:2] = limits.shorten(move[:2], np.asarray(gripper[:2], np.float64))
        message = TwistStamped()
        message.header.stamp = (self._node.get_clock().now().to_msg()
                                if params['stamp_with_now'] else stamp)
        message.header.frame_id = params['command_frame']
        linear = message.twist.linear
        linear.x, linear.y, linear.z = (move / params['control_period']).tolist()
        with self._lock:
            now = time.monotonic()
            self._tick()
            if self._stood_s and ages:
                raise PlanningError(f'the planner stood still for {self._stood_s:.1f} s; what it '
                                    'sees may be old. Send the goal again')
            if self._closed or self._goal is not goal or self._silent(topics, now):
                return False
            self._topics, self._moved_at = tuple(topics), now
            self._stamps = to_nanoseconds(message.header.stamp), to_nanoseconds(stamp)
            self._gripper.publish(Float64(data=float(np.clip(action[3], 0, 1))))
            self._twist.publish(message)
        return True

    def answered(self, stamp_ns: int) -> int:
        """Return the stamp of the image that the last command answers; of another, its own."""
        sent_ns, image_ns = self._stamps
        return image_ns if stamp_ns == sent_ns else stamp_ns

    def close(self, seconds: float) -> None:
        """Stop the arm for good; wait until the command was delivered, at most so many seconds."""
        with self._lock:
            self._closed, self._goal = True, None
            self._stop()
            self._lock.notify()
        self._thread.join(seconds)
        self._twist.wait_for_all_acked(Duration(seconds=seconds))

    def _on_period(self, message: Float64) -> None:
        if not self._echoed and message.data == self._params['control_period']:
            self._echoed = True
        elif 0 < message.data < math.inf:
            self._period = message.data

    def _watch(self) -> None:
        """Stop the arm when the last command or a sensor is too old, until close."""
        while not self._closed:
            with self._lock:
                if self._goal is None:
                    self._lock.wait_for(lambda: self._goal is not None or self._closed)
                    continue
                self._tick()
                try:
                    now = time.monotonic()
                    if now - self._stopped_at >= REPEAT_S and (
                            now - self._moved_at > self._params['max_silence']
                            or self._silent(self._topics, now)):
                        self._stop()
                except Exception as error:  # this thread must not end
                    self._node.get_logger().error(
                        f'the watch of the arm failed: {type(error).__name__}: {escaped(error)}',
                        throttle_duration_sec=1.0)
            time.sleep(WATCH_S)

    def _tick(self) -> None:
        """Measure the time since the last check, to detect that the process stood still."""
        now = now_awake()
        if now - self._ticked_at > STOOD_S:
            self._stood_s = now - self._ticked_at
        self._ticked_at = now

    def _silent(self, topics: Collection[str], now: float) -> bool:
        """Return whether one of the topics is silent."""
        ages = self._sensors.ages(topics, now)
        return any(age > self._params['max_silence'] for age in ages.values())

    def _stop(self) -> None:
        """Send a zero command; it has no stamp, since it answers no image."""
        self._stopped_at = time.monotonic()
        self._twist.publish(TwistStamped())


def now_awake() -> float:
    """Return a monotonic time in s that includes suspension of the machine."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
