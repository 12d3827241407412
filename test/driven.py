# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera, a tracker, joints and an arm of the tests' own, which do as they are told."""

from functools import cache
import threading
import time

from geometry_msgs.msg import TwistStamped
import numpy as np
from processes import until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState
from sim_bridge.simulator import Simulator
from tap_msgs.msg import CommandRefused, ObjectStates
from tap_ros.base.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.ros.calls import CallError
from tap_ros.ros.requests import request_fields
from tap_ros.ros.topics import encode_image, encode_joints, encode_objects, STREAM, to_stamp

STOP_S = 0.5  # within which a stop has to come
MOVING_S = 60.0  # a plan takes seconds where other programs run
TOPICS = {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects'),
          'joints': (JointState, 'joint_states')}
SEED = 1_000_003


@cache
def first_pictures(image_size=64):
    """Return the first Observation of a scene and its goal, from the simulator itself."""
    simulator = Simulator('push2', image_size)
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


def select(client, clicks, stamp_ns=0):
    """Select objects {name: (u, v)} once the tracker has a picture of the scene, or that one."""
    def accepted():
        try:
            client.select(clicks, stamp_ns)
        except CallError as error:
            assert 'no picture of the new' in str(error) or 'nothing has come' in str(error)
            return False
        return True
    assert until(accepted)


class World:
    """
    Publish the first moment of a scene again and again, with the stamps of the wall clock.

    Whatever the arm is told, nothing moves, so that a goal goes on for as long as a trial needs.

    :param node: rclpy Node.
    :param rate_hz: how often.
    :ivar silent: names of what is not published, of TOPICS.
    :ivar objects: (K, 2) pixels and K names published, each None for the true ones.
    :ivar states: of the objects, published with them; [] for none.
    :ivar gripper: (4,) published, None for the true one; joints: {name: rad} of an arm instead.
    :ivar shift_s: added to all stamps; late_s: by which the joints are older than the rest.
    :ivar frozen: {topic: stamp in ns that it repeats}.
    :ivar clock_ns: that a clock repeats; None: there is none.
    :ivar sent: when each topic was published last, time.monotonic().
    """

    def __init__(self, node, rate_hz=10.0):
        self.sent, self._began = {}, 0.0
        self._reset()
        self._seen = first_pictures()[0]
        self._node, self._period = node, 1.0 / rate_hz
        self._publishers = {topic: node.create_publisher(kind, name, STREAM)
                            for topic, (kind, name) in TOPICS.items()}
        self._clock = node.create_publisher(Clock, 'clock', STREAM)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='world', daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        for publisher in (*self._publishers.values(), self._clock):
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
        self.silent, self.frozen, self.clock_ns = set(), {}, None
        self.shift_s = self.late_s = 0.0
        self.objects, self.states, self.gripper, self.joints = (None, None), [], None, {}

    def silence(self, *topics):
        """Publish these no longer; return when the last of them was sent."""
        self.silent |= set(topics)
        time.sleep(self._period / 2)  # what is on its way
        return max(self.sent.get(topic, time.monotonic()) for topic in topics)

    def messages(self, now_ns):
        """Return {topic: message} of this moment."""
        gripper = self._seen.gripper if self.gripper is None else self.gripper
        image, objects, joints = (to_stamp(self.frozen.get(topic, at)) for topic, at in zip(
            TOPICS, (now_ns, now_ns, now_ns - int(1e9 * self.late_s))))
        seen = objects_message(self._seen, objects, *self.objects)
        seen.states = self.states
        told = encode_joints(gripper, joints, WORLD_FRAME)
        if self.joints:
            told.name, told.position = list(self.joints), list(self.joints.values())
        return {'joints': told, 'objects': seen,
                'image': encode_image(self._seen.image, image, CAMERA_FRAME)}

    def publish(self, messages):
        """Publish some messages by topic, but those of what is silent."""
        for topic, message in messages.items():
            if topic not in self.silent:
                self._publishers[topic].publish(message)
                self.sent[topic] = time.monotonic()

    def _run(self):
        while not self._stop.wait(self._period):
            began = time.monotonic()
            if self.clock_ns is not None:
                self._clock.publish(Clock(clock=to_stamp(self.clock_ns)))
            self.publish(self.messages(time.time_ns() + int(self.shift_s * 1e9)))
            self._began = began


class Arm:
    """
    Keep every twist command, as a driver of the arm would get it.

    :param node: rclpy Node that another thread spins.
    :ivar refusing: whether it refuses each command, as after a protective stop.
    """

    def __init__(self, node):
        self.refusing = False
        self._kept = []  # (time.monotonic(), whether it is a move)
        self._refused = node.create_publisher(CommandRefused, 'arm/refused', STREAM)
        node.create_subscription(TwistStamped, 'arm/delta_twist_cmds', self._put, STREAM)

    def moves(self, moment):
        """Return when the commands after a moment of time.monotonic() came that are no stops."""
        return [at for at, move in list(self._kept) if at > moment and move]

    def forget(self):
        """Drop all."""
        self._kept.clear()

    def seconds_to_stop(self, moment):
        """
        Return the seconds from a moment to the stop after which nothing moved; inf without one.

        A stop that was sent before counts as 0 s where no move came after the moment.
        """
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
        self._kept.append((time.monotonic(), move))
        if move and self.refusing:
            self._refused.publish(CommandRefused(
                header=message.header, message='protective stop; release it on the pendant'))
