# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera, an object tracker and an arm of the attacker's own; each can fall silent alone."""

from functools import cache
import threading
import time

import numpy as np
from sensor_msgs.msg import Image, JointState
from sim_bridge.simulator import Simulator
from tap_msgs.msg import ObjectStates
from tap_ros.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.nodes.client import request_fields
from tap_ros.nodes.ros_messages import encode_image, encode_joints, encode_objects
from tap_ros.nodes.topics import STREAM, to_stamp

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
    :ivar pixels: (K, 2) pixels published, or None for the true ones.
    :ivar gripper: (4,) published, or None for the true one.
    :ivar names: object names, or None for the true ones.
    :ivar shift_s: added to all stamps.
    :ivar sent: when each topic was published last, time.monotonic().
    """

    def __init__(self, node, rate_hz=10.0):
        self.silent, self.sent = set(), {}
        self.pixels = self.names = self.gripper = None
        self.shift_s = 0.0
        self._seen = first_pictures()[0]
        self._node, self._period = node, 1.0 / rate_hz
        self._publishers = {topic: node.create_publisher(kind, name, STREAM)
                            for topic, (kind, name) in TOPICS.items()}
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name='world', daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def silence(self, *topics):
        """Publish these no longer; return when the last of them was sent."""
        with self._lock:
            self.silent |= set(topics)
            return max(self.sent.get(topic, time.monotonic()) for topic in topics)

    def restore(self):
        """Publish everything as it is again."""
        with self._lock:
            self.silent = set()
            self.pixels = self.names = self.gripper = None
            self.shift_s = 0.0

    def spoil(self, **values):
        """Set pixels, names or gripper to something else until restore."""
        with self._lock:
            for name, value in values.items():
                setattr(self, name, value)

    def messages(self, stamp):
        """Return {topic: message} of this moment."""
        gripper = self._seen.gripper if self.gripper is None else self.gripper
        return {'joints': encode_joints(gripper, stamp, WORLD_FRAME),
                'objects': objects_message(self._seen, stamp, self.pixels, self.names),
                'image': encode_image(self._seen.image, stamp, CAMERA_FRAME)}

    def _run(self):
        while not self._stop.wait(self._period):
            with self._lock:
                stamp = to_stamp(time.time_ns() + int(self.shift_s * 1e9))
                for topic, message in self.messages(stamp).items():
                    if topic not in self.silent:
                        self._publishers[topic].publish(message)
                        self.sent[topic] = time.monotonic()
