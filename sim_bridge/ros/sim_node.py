# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulator as a ROS node: camera, objects and clock out, twist commands in."""

from collections.abc import Callable
from dataclasses import dataclass
import math
import time
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer
from sim_bridge.ros.publishers import ScenePublishers
from sim_bridge.world.looks import CHOICES, DEFAULT_LOOK, LOOKS
from sim_bridge.world.protocol import ability, make_world, Observation, World
from std_msgs.msg import Bool, Float64
from std_srvs.srv import SetBool
from tap_msgs.msg import CommandRefused, Episode
from tap_msgs.srv import ResetScene, SetGoal, StepScene
from tap_ros.base.contract import CAMERA_SIZE, CONTROL_PERIOD, SPEED_LIMIT, WORLD_FRAME
from tap_ros.base.errors import TapError
from tap_ros.messages import topics
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.robots.arm import DEFAULT_ARM
from tap_ros.ros.calls import answering
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.observations import reception_time
from tap_ros.ros.parameters import Parameters, setting
from tap_ros.ros.subscriptions import steady_timer
from tap_ros.ros.topics import LATCHED, LOCK_STEP, SERVICE_QOS, STREAM, to_stamp

PERIOD_NS = round(CONTROL_PERIOD * 1e9)
FIRST_STAMP = 10**9  # ns; a stamp of zero means "unstamped", so time starts later
COMMAND_TIMEOUT, MAX_TIMEOUT = 1.0, 60.0  # s that a command is valid, unless its sender says so
MAX_PERIODS = 100  # of a call that is answered when they have passed: about a second
LAST_MARK_S = 1.0  # s that the end mark of the last episode may take to arrive


class SimNode(Node):
    """
    Steps and renders in the thread that spins, to which the OpenGL context belongs.

    A command is a velocity, m/s, that lasts for one control period.
    Lock-step: a command stamped like the newest image, or unstamped, lets one control period pass.
    Meanwhile the newest image, and what belongs to it, is sent again every resend_period with the
    same stamp, for nodes that start late.
    Real time: a timer does, with the command that came since the last period, else standing still.
    A command is valid for COMMAND_TIMEOUT, or what arm/command_timeout says, after it came; later
    the arm stands still.
    A zero twist without a stamp means stop in both modes and lets no time pass. Whoever sends a
    command that is not carried out learns it from arm/refused.
    Paused: commands are refused, and what came before or meanwhile is not made up for.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('sim_node', **options)
        self.params = declare_parameters(self)
        task = self.params['task']
        self._sim = self._make_world(task)
        self._seed = 0  # of the present scene
        self._hide_arm = False
        self._opening = 0.0  # the newest gripper command
        self._done_opening = 0.0  # that of the last period
        self._twist: np.ndarray | None = None  # real time: the command for the next period
        self._valid_until = 0.0  # monotonic time at which it runs out
        self._timeout = COMMAND_TIMEOUT
        self._stamp_ns = FIRST_STAMP  # of the newest image; never goes back, unlike the physics
        self._answered_ns = 0  # stamp of the newest image that was answered by a command
        self._reset_ns = FIRST_STAMP
        self._goal_ns = 0  # stamp of the newest goal
        self._num_steps = 0
        self._in_episode = False
        self._paused, self._played_at = False, 0.0  # monotonic time at which it went on
        self._diagnostics = Diagnostics(self, (), ['arm/delta_twist_cmds', 'gripper/command'])
        self._topics = ScenePublishers(
            self, self._sim, self.params['observer'], self.params['objects'] == 'tracked')
        self._refused = self.create_publisher(CommandRefused, 'arm/refused', STREAM)
        self._episode = self.create_publisher(Episode, 'episode', STREAM)
        self._lock_step = self.create_publisher(Bool, LOCK_STEP, LATCHED)
        self._lock_step.publish(Bool(data=self.params['lock_step']))
        self.create_publisher(Float64, topics.CONTROL_PERIOD.name, LATCHED).publish(
            Float64(data=CONTROL_PERIOD))
        # Subscribed before the twist, so that of two commands sent together it is taken first.
        subscribe: Callable[..., Any] = self.create_subscription  # rclpy does not type the info
        subscribe(Float64, 'gripper/command', self._on_gripper, STREAM)
        subscribe(TwistStamped, 'arm/delta_twist_cmds', self._on_twist, STREAM)
        subscribe(Float64, 'arm/command_timeout', self._on_timeout, LATCHED)
        self._resend: Timer | None = None
        self._reset(task, self.params['seed'], False)
        for kind, name, answer in ((ResetScene, 'sim/reset', self._on_reset),
                                   (SetGoal, 'sim/set_goal', self._on_set_goal),
                                   (StepScene, 'sim/step', self._on_step),
                                   (SetBool, 'sim/pause', self._on_pause)):
            self.create_service(kind, name, answering(self, answer), qos_profile=SERVICE_QOS)
        factor, mode = self.params['real_time_factor'], 'lock-step'
        if self.params['lock_step']:
            self._resend = steady_timer(
                self, self.params['resend_period'], self._topics.send_newest)
        else:
            steady_timer(self, CONTROL_PERIOD / factor, self._on_timer)
            mode = f'{factor:g} x real time'
        self.get_logger().info(f'ready: task {task}, seed {self.params["seed"]}, {mode}')

    def close(self) -> None:
        """End the episode, and wait until its mark has been delivered."""
        self._end_episode()
        self._sim.close()
        self._episode.wait_for_all_acked(Duration(seconds=LAST_MARK_S))

    # Commands

    def _on_gripper(self, message: Float64, info: dict[str, Any]) -> None:
        self._diagnostics.received('gripper/command')
        reason = self._refuse_paused(info) or ('' if math.isfinite(message.data) else (
            f'data is {message.data}; expected a number from 0 (closed) to 1 (open)'))
        if reason:
            self.get_logger().warning(
                f'gripper/command ignored: {reason}', throttle_duration_sec=5.0)
        else:
            self._opening = min(max(message.data, 0.0), 1.0)

    def _on_twist(self, message: TwistStamped, info: dict[str, Any]) -> None:
        self._diagnostics.received('arm/delta_twist_cmds')
        stamp_ns = to_nanoseconds(message.header.stamp)
        speed = np.array([getattr(message.twist.linear, axis) for axis in 'xyz'])
        move = CONTROL_PERIOD * speed
        if stamp_ns == 0 and not speed.any():
            self._twist = None
            return
        if reason := self._refuse_paused(info) or self._refuse_twist(
                message.twist, move, stamp_ns):
            self.get_logger().warning(f'arm/delta_twist_cmds ignored: {reason}')
            self._diagnostics.error(f'arm/delta_twist_cmds ignored: {reason}')
            self._refused.publish(CommandRefused(header=message.header, message=reason))
            return
        if (np.abs(speed) > SPEED_LIMIT).any():
            self.get_logger().warning(
                f'arm/delta_twist_cmds limited: {speed} to +-{SPEED_LIMIT} m/s',
                throttle_duration_sec=5.0)
        self._answered_ns = max(stamp_ns, self._answered_ns)
        if self.params['lock_step']:
            self._step(move)
        else:
            self._twist = move
            self._valid_until = (reception_time(info)
                                 + self._timeout / self.params['real_time_factor'])

    def _on_timeout(self, message: Float64) -> None:
        if not 0 < message.data <= MAX_TIMEOUT:
            self.get_logger().warning(
                f'arm/command_timeout ignored: data is {message.data}; expected seconds, more '
                f'than 0 and at most {MAX_TIMEOUT:g}')
            return
        self._timeout = message.data

    def _refuse_paused(self, info: dict[str, Any]) -> str:
        """Say why a command that came now cannot be used; an empty string if it can."""
        if self._paused:
            return 'the simulation is paused; call sim/pause with data false'
        if reception_time(info) < self._played_at:
            return 'it came while the simulation was paused'
        return ''

    def _refuse_twist(self, twist: Twist, move: np.ndarray, stamp_ns: int) -> str:
        """Say why a command cannot be used; an empty string if it can."""
        for axis, value in zip('xyz', move):
            if not math.isfinite(value):
                return f'twist.linear.{axis} is {value}; expected finite numbers'
        if any(getattr(twist.angular, axis) != 0 for axis in 'xyz'):
            return 'twist.angular is not zero; this gripper moves but cannot turn'
        try:
            self._sim.check_action(np.append(move, self._opening))
        except TapError as error:
            return str(error)
        if stamp_ns == 0:
            return ''
        if stamp_ns > self._stamp_ns:
            return (f'its stamp {stamp_ns} ns is newer than the newest image '
                    f'({self._stamp_ns} ns); use the stamp of the image it answers')
        if stamp_ns <= self._answered_ns or stamp_ns < self._reset_ns:
            return f'the image stamped {stamp_ns} ns was answered before, or is of an old scene'
        if self.params['lock_step'] and stamp_ns < self._stamp_ns:
            return (f'it answers the image stamped {stamp_ns} ns; '
                    f'the newest is stamped {self._stamp_ns} ns')
        return ''

    def _on_timer(self) -> None:
        if not self._paused:
            move, self._twist = self._twist, None
            late = time.monotonic() > self._valid_until
            self._step(np.zeros(3) if move is None or late else move)

    # Services

    def _on_reset(self, request: ResetScene.Request,
                  _: ResetScene.Response) -> ResetScene.Response:
        self._reset(request.task or 'push2', request.seed, request.hide_arm)
        return ResetScene.Response(
            success=True, message=f'{self._sim.task_name}, seed {request.seed}')

    def _on_set_goal(self, request: SetGoal.Request, _: SetGoal.Response) -> SetGoal.Response:
        names, pixels = decode_objects(
            request.objects, 'objects', self._sim.goal().image.shape[:2])
        ability(self._sim, 'move_goal')(names, pixels)
        self._publish_goal()
        return SetGoal.Response(success=True, message=f'moved {", ".join(names)}')

    def _on_step(self, request: StepScene.Request,
                 response: StepScene.Response) -> StepScene.Response:
        periods = request.num_periods or 1
        if periods > MAX_PERIODS:
            response.message = (
                f'num_periods is {periods}; expected 1 to {MAX_PERIODS}, call more often')
        elif not (self._paused or self.params['lock_step']):
            response.message = (
                'time passes by itself; pause with sim/pause first, or start with lock_step')
        else:
            for _ in range(periods):
                self._step(np.zeros(3))
            response.success = True
            response.message = f'{periods} control periods passed'
        response.stamp = to_stamp(self._stamp_ns)
        return response

    def _on_pause(self, request: SetBool.Request, _: SetBool.Response) -> SetBool.Response:
        if request.data != self._paused:  # what was commanded and is not done yet is forgotten
            self._twist, self._opening = None, self._done_opening
            self._paused = request.data
            self._played_at = math.inf if self._paused else time.monotonic()
        return SetBool.Response(success=True, message='paused' if request.data else 'running')

    # Simulation

    def _make_world(self, task: str) -> World:
        options = {name: self.params[name] for name in ('look', 'appearance', 'arm')
                   if self.params[name] != getattr(SimParameters, name)}
        return make_world(self.params['world'], task, self.params['image_size'], **options)

    def _reset(self, task: str, seed: int, hide_arm: bool) -> None:
        """Start a scene; if it cannot be, the present one stays as it is."""
        sim = self._sim if task == self._sim.task_name else self._make_world(task)
        self._end_episode()
        observation = sim.reset(seed)
        if sim is not self._sim:
            self._sim.close()
        self._sim, self._hide_arm, self._seed = sim, hide_arm, seed
        self._opening, self._done_opening, self._twist = 0.0, 0.0, None
        self._stamp_ns += PERIOD_NS
        self._reset_ns = self._stamp_ns
        self._num_steps = 0
        self._in_episode = True
        self._publish_episode(Episode.START, '')
        self._topics.frames(sim, to_stamp(self._stamp_ns))
        self._publish_goal()
        self._publish(observation)

    def _step(self, move: np.ndarray) -> None:
        """Let one control period pass and publish what the camera then sees."""
        begin = time.perf_counter()
        observation = self._sim.step(np.append(move, self._opening))
        self._done_opening = self._opening
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'step')
        self._stamp_ns += PERIOD_NS
        self._num_steps += 1
        self._publish(observation)

    def _end_episode(self) -> None:
        if self._in_episode:
            self._in_episode = False
            outcome = self._sim.outcome() if self._num_steps else 'interrupted'
            self._publish_episode(Episode.END, outcome)

    # Messages

    def _publish(self, observation: Observation) -> None:
        if self._hide_arm:
            observation = self._sim.observe(hide_arm=True)
        self._topics.moment(self._sim, observation, to_stamp(self._stamp_ns))
        if self._resend is not None:
            self._resend.reset()

    def _publish_goal(self) -> None:
        # Each goal has a stamp of its own, also where no time has passed since the last one.
        self._goal_ns = max(self._stamp_ns, self._goal_ns + 1)
        self._topics.goal(self._sim.goal(self._hide_arm), to_stamp(self._goal_ns))

    def _publish_episode(self, event: int, outcome: str) -> None:
        message = Episode(
            event=event, task=self._sim.task_name, seed=self._seed, outcome=outcome)
        # Not before its goal, else a recording would not count that.
        message.header.stamp = to_stamp(max(self._stamp_ns, self._goal_ns))
        message.header.frame_id = WORLD_FRAME
        self._episode.publish(message)


@dataclass(frozen=True)
class SimParameters:
    """
    Parameters of the node.

    :param world: The simulated world; other packages may add some.
    :param task: Task of the first scene, one that the world has.
    :param seed: Seed of the first scene.
    :param image_size: Width and height of the pictures in pixels.
    :param look: What the camera's pictures show: the whole arm at a wooden table, or its hand
        alone.
    :param arm: The arm at the table.
    :param appearance: Table, light and camera; random: drawn from the seed of each scene.
    :param observer: Publish observer/image_raw, the camera's view with the whole arm.
    :param objects: Where the objects of all nodes come from: objects and goal/objects are the
        ground truth, or tracker_node's, and the truth is on truth/objects and truth/goal/objects
        (tracked).
    :param lock_step: True: each twist command lets one control period pass, so that runs repeat
        exactly. False: time passes by itself.
    :param resend_period: Seconds after which, in lock-step, the newest picture is sent again.
    :param real_time_factor: Simulated seconds per second when not in lock-step.
    """

    world: str = setting('mujoco_table', plugins='tap_ros.worlds')
    task: str = 'push2'
    seed: int = setting(0, between=(0, 2**62))
    image_size: int = setting(CAMERA_SIZE, between=(16, 1024))
    look: str = setting(DEFAULT_LOOK, choices=tuple(LOOKS))
    arm: str = setting(DEFAULT_ARM, plugins='tap_ros.arms')
    appearance: str = setting('usual', choices=tuple(CHOICES))
    observer: bool = False
    objects: str = setting('truth', choices=('truth', 'tracked'))
    lock_step: bool = False
    resend_period: float = setting(0.2, between=(0.02, 10.0))
    real_time_factor: float = setting(1.0, between=(0.05, 20.0))


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_fields(SimParameters)
    return parameters
