# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes under attack, a client of them, a world of its own, and what the arm would be told."""

from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
import signal
import threading
import time

from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import Newest, NodeProcess
from sensor_msgs.msg import Image, JointState
from sim_bridge.simulator import Simulator
from tap_msgs.msg import CommandRefused, ObjectStates
from tap_ros.contract import CAMERA_FRAME, NODE_MODULES, WORLD_FRAME
from tap_ros.errors import TapError
from tap_ros.nodes.client import Client, PLANNER, READY, request_fields
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.ros_messages import encode_image, encode_joints, encode_objects
from tap_ros.nodes.topics import STREAM, to_stamp

CALL_S = 20.0
MOVING_S = 60.0  # a plan takes seconds where other programs run
STOP_S = 0.5
SIM_MODES = {'lock-step': {'lock_step': True}, 'real': {'lock_step': False}}
TOPICS = {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects'),
          'joints': (JointState, 'joint_states')}
SEED = 1_000_003


@cache
def first_pictures():
    """Return the first Observation of a scene and its goal, from the simulator itself."""
    simulator = Simulator('push2')
    try:
        return simulator.reset(SEED), simulator.goal()
    finally:
        simulator.close()


def objects_message(observation, stamp, pixels=None, names=None):
    """Return tap_msgs/ObjectStates of an Observation, with other pixels or names if given."""
    pixels = observation.object_pixels if pixels is None else pixels
    names = observation.object_names if names is None else names
    poses = np.resize(observation.object_poses, (len(names), 7))
    return encode_objects(names, pixels, poses, stamp, WORLD_FRAME,
                          ObjectStates.SOURCE_GROUND_TRUTH)


def goal_fields(mode='direct', **fields):
    """Return arguments of Client.reach for a goal that needs no goal topics."""
    _, goal = first_pictures()
    pixels = dict(zip(goal.object_names, goal.object_pixels))
    return {'goal': goal.image, 'goal_pixels': pixels, 'mode': mode, 'step_budget': 1000, **fields}


def predict_fields(**fields):
    """Return fields of a whole predict_subgoal request."""
    start, goal = first_pictures()
    return request_fields(
        start.object_names, start=start.image, goal=goal.image, start_objects=start.object_pixels,
        goal_objects=goal.object_pixels) | fields


class World:
    """
    Publish the first moment of a scene again and again, with the stamps of the wall clock.

    Whatever the arm is told, nothing moves, so that a goal goes on for as long as a trial needs.

    :param node: rclpy Node.
    :param rate_hz: how often.
    :ivar silent: names of what is not published, of TOPICS.
    :ivar objects: (K, 2) pixels and K names published, each None for the true ones.
    :ivar gripper: (4,) published, None for the true one.
    :ivar shift_s: added to all stamps.
    :ivar frozen: the stamp in ns of all messages, None: that of the moment.
    :ivar sent: when each topic was published last, time.monotonic().
    """

    def __init__(self, node, rate_hz=10.0):
        self.sent, self._began = {}, 0.0
        self._reset()
        self._seen = first_pictures()[0]
        self._node, self._period = node, 1.0 / rate_hz
        self._publishers = {topic: node.create_publisher(kind, name, STREAM)
                            for topic, (kind, name) in TOPICS.items()}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='world', daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def restore(self):
        """Publish everything as it is again; return when that has begun."""
        self._reset()
        return self.renewed()

    def renewed(self):
        """
        Wait for messages that are made from now on; return the moment when their round began.

        On a busy machine that takes longer than a period, and until then nobody can know.
        """
        begin = time.monotonic()
        while self._began <= begin:
            time.sleep(0.005)
        return self._began

    def _reset(self):
        self.silent, self.frozen, self.shift_s = set(), None, 0.0
        self.objects, self.gripper = (None, None), None

    def silence(self, *topics):
        """Publish these no longer; return when the last of them was sent."""
        self.silent |= set(topics)
        time.sleep(self._period / 2)  # what is on its way
        return max(self.sent.get(topic, time.monotonic()) for topic in topics)

    def messages(self, stamp):
        """Return {topic: message} of this moment."""
        gripper = self._seen.gripper if self.gripper is None else self.gripper
        return {'joints': encode_joints(gripper, stamp, WORLD_FRAME),
                'objects': objects_message(self._seen, stamp, *self.objects),
                'image': encode_image(self._seen.image, stamp, CAMERA_FRAME)}

    def publish(self, messages):
        """Publish some messages by topic, but those of what is silent."""
        for topic, message in messages.items():
            if topic not in self.silent:
                self._publishers[topic].publish(message)
                self.sent[topic] = time.monotonic()

    def _run(self):
        while not self._stop.wait(self._period):
            began = time.monotonic()
            now = time.time_ns() + int(self.shift_s * 1e9)
            self.publish(self.messages(to_stamp(self.frozen or now)))
            self._began = began


class Arm:
    """
    Keep every twist command, as a driver of the arm would get it.

    :param node: rclpy Node that another thread spins.
    :ivar refusing: whether it refuses each command, as after a protective stop.
    """

    def __init__(self, node):
        self.refusing = False
        self._kept, self._changed = [], threading.Condition()  # (time.monotonic(), whether a move)
        self._refused = node.create_publisher(CommandRefused, 'arm/refused', STREAM)
        node.create_subscription(TwistStamped, 'arm/delta_twist_cmds', self._put, STREAM)

    def moves(self, moment):
        """Return when the commands after a moment of time.monotonic() came that are no stops."""
        with self._changed:
            return [at for at, move in self._kept if at > moment and move]

    def forget(self):
        """Drop all."""
        with self._changed:
            self._kept.clear()

    def wait_for_moves(self, moment, count, timeout_s=MOVING_S):
        """Wait until so many moves have come after a moment; tell whether they have."""
        with self._changed:
            return self._changed.wait_for(
                lambda: sum(at > moment and move for at, move in self._kept) >= count, timeout_s)

    def seconds_to_stop(self, moment):
        """
        Return the seconds from a moment to the stop after which nothing moved; inf without one.

        A stop that was sent before counts as 0 s where no move came after the moment.
        """
        with self._changed:
            kept = list(self._kept)
        last = max((index for index, (_, move) in enumerate(kept) if move), default=-1)
        return max(0.0, kept[last + 1][0] - moment) if kept[last + 1:] else float('inf')

    def assert_still(self, moment):
        """Raise AssertionError if a move came after a moment."""
        moves = self.moves(moment)
        assert not moves, f'{len(moves)} moves, the last {moves[-1] - moment:.1f} s too late'

    def assert_stopped(self, moment, limit_s=STOP_S):
        """Raise AssertionError unless a stop came within a limit, and no move after that."""
        self.assert_still(moment + limit_s)
        seconds = self.seconds_to_stop(moment)
        assert seconds <= limit_s, f'the stop came after {seconds:.2f} s'

    def _put(self, message):
        linear = message.twist.linear
        move = any((linear.x, linear.y, linear.z))
        with self._changed:
            self._kept.append((time.monotonic(), move))
            self._changed.notify_all()
        if move and self.refusing:
            self._refused.publish(CommandRefused(
                header=message.header, message='protective stop; release it on the pendant'))


class Rig:
    """
    The nodes under attack, started when a fault needs them, and a client of them.

    :param folder: of the logs.
    """

    def __init__(self, folder):
        self.folder, self.processes = Path(folder), {}
        self.client = Client(timeout_s=CALL_S)
        self.node = self.client.node
        self._reaching = None
        self.joints = Newest(self.node, JointState, 'joint_states', STREAM)
        self.arm = Arm(self.node)
        self.alive = {name: Liveness(self.node, name) for name in NODE_MODULES}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for name in list(self.processes):
            self.remove(name)
        self.client.close()

    # Nodes

    def need(self, *names, sim=None, parameters=None):
        """
        Have these nodes running and ready, no others, and none with a goal.

        :param names: names of NODE_MODULES without sim_node.
        :param sim: 'lock-step', 'real' or None for no simulator.
        :param parameters: {node: its parameters}, beside those that it always gets.
        """
        wanted = {name: {} for name in names}
        if 'recorder_node' in wanted:
            wanted['recorder_node'] = {'folder': self.folder / 'bag'}
        if sim is not None:
            wanted['sim_node'] = SIM_MODES[sim]
        wanted = {name: own | (parameters or {}).get(name, {}) for name, own in wanted.items()}
        for name, process in list(self.processes.items()):
            if name not in wanted or process.parameters != wanted[name] or not process.alive:
                self.remove(name)
        new = [self.start(name, **parameters) for name, parameters in wanted.items()
               if name not in self.processes]
        for process in new:
            process.wait_for('ready')
        if new:
            for name in wanted.keys() & {*READY, PLANNER}:
                self.client.wait_until_ready(name, timeout_s=CALL_S)
            if 'predictor_node' in wanted:
                self.expect_prediction(CALL_S)
            time.sleep(0.5)  # what has no name to wait for: its subscriptions
        elif self._reaching is not None and PLANNER in wanted:
            with suppress(TapError):  # it may have ended, or looked dead on a busy machine
                self.finish(self._reaching)
            time.sleep(1.0)
        self._reaching, self.arm.refusing = None, False
        self.arm.forget()

    def start(self, name, **parameters):
        """Start a node without waiting; return the NodeProcess."""
        self.processes[name] = NodeProcess(name, self.folder / f'{name}.log', parameters)
        return self.processes[name]

    def restart(self, name):
        """Start a killed node again, and wait until it is ready and its heartbeat is heard."""
        self.processes[name].start().wait_for('ready')
        self.alive[name].wait_until_alive(5.0)

    def remove(self, name):
        """End a node, politely first."""
        self.processes.pop(name).end(signal.SIGINT, 10.0)

    def check(self):
        """Raise AssertionError when a node has ended."""
        for process in self.processes.values():
            process.check()

    @contextmanager
    def world(self, rate_hz=10.0):
        """Have a World that the planner has heard of."""
        with World(self.node, rate_hz) as world:
            time.sleep(1.0)
            yield world

    # Calls

    def expect_prediction(self, timeout_s):
        """Make a good call; raise TapError when it is not answered well."""
        self.client.call('predict', timeout_s, **predict_fields())

    def reset(self, seed, task='push2'):
        """Start a scene."""
        self.client.call('reset', task=task, seed=seed)

    def begin(self, **fields):
        """Send a goal, by default one that a World never fulfils; return its Reaching."""
        self._reaching = self.client.reach(**{'timeout_s': 90.0, **(fields or goal_fields())})
        return self._reaching

    def begin_moving(self, **fields):
        """Send a goal, and wait until the arm moves; once more on a machine too busy for it."""
        for _ in range(2):
            begin = time.monotonic()
            reaching = self.begin(**fields)
            if self.arm.wait_for_moves(begin, 1):
                return reaching
            end = self.finish(reaching)
        raise TapError(f'nothing moved within {MOVING_S:g} s; the goal {end}')

    def finish(self, reaching):
        """Cancel a goal, and return its end in words."""
        reaching.cancel()
        return self.result(reaching)

    def result(self, reaching):
        """Wait for the end of a goal; return it in words, the message behind a colon."""
        result = reaching.result()
        self._reaching = None
        return f'{result.end}: {result.message}'

    def expect_end(self, reaching, words, within='', timeout_s=30.0):
        """Raise AssertionError unless a goal ends in time with these words and those within."""
        begin = time.monotonic()
        end = self.result(reaching)
        assert end.startswith(words) and within in end, f'the goal {end}'
        took = time.monotonic() - begin
        assert took < timeout_s, f'the goal ended after {took:.0f} s'
        return end
