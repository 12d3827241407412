# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs of visual_mpc_node: messages grouped by their stamp, and decoded once."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
import math
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from tap_msgs.msg import Episode, ObjectStates
from tap_ros.base.errors import ImageError, KinematicsError, PlanningError, TapError
from tap_ros.images.crop import TrainedCrop
from tap_ros.images.pixels import check_image
from tap_ros.messages.images import decode_image
from tap_ros.messages.joints import GripperHistory
from tap_ros.messages.objects import decode_cut_objects, decode_states
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import JOINT_STATES
from tap_ros.planning.reach import Observation
from tap_ros.robots.arm import get_arm
from tap_ros.ros.arm_place import ArmPlace
from tap_ros.ros.observations import JUMP_NS, Moment, Observations, reception_time
from tap_ros.ros.parameters import Parameters
from tap_ros.ros.robot_view import RobotView
from tap_ros.ros.subscriptions import publishers_of, rivals
from tap_ros.ros.topics import camera_topics, LATCHED, LOCK_STEP, of_topic, STREAM


class PlannerInputs:
    """
    The newest picture with its objects and joints, for one goal at a time.

    With the parameter robot_mask the picture is without the robot, all that is seen; a picture
    whose mask has not come is not seen. Joint states have times of their own: the gripper of a
    picture is found between the states before and after it.

    :param node: rclpy Node.
    :param params: its Parameters.
    :param crop: returns the TrainedCrop: what the planner makes of pictures, and the size that
        they get.
    :param on_message: called with the topic name after each message.
    :ivar topics: short names of what is looked at, the joints last.
    :ivar sensors: Observations.
    :ivar robot: RobotView.
    :ivar frame_id: of the picture that was seen last.
    """

    def __init__(self, node: Node, params: Parameters, crop: Callable[[], TrainedCrop],
                 on_message: Callable[[str], object]) -> None:
        self._node, self._params, self._crop, self._on_message = node, params, crop, on_message
        self.robot = RobotView(params['robot_mask'])
        types = {**camera_topics(params), 'joints': of_topic(JOINT_STATES)}
        self.topics = tuple(types)
        self._names = {key: name for key, (_, name) in types.items()}
        self._full = {key: node.resolve_topic_name(name) for key, name in self._names.items()}
        self.sensors = Observations(*types)
        self._gripper = GripperHistory(
            get_arm(params['arm']), params['joint_prefix'], params['fixed_opening'],
            ArmPlace(node, params).mount)
        self._joints_error = ''  # why the joint states cannot be used
        self._camera_size: tuple[int, int] | None = None
        self._episode = 0, 0  # stamp of its beginning, and jumps of the clock until then
        self._lock_step = False  # as it was told last
        self.begin(0.0)
        self.sensors.subscribe(node, types, STREAM, on_message=self._on_camera,
                               others={'joints': self._on_joints})
        node.create_subscription(Episode, 'episode', self._on_episode, STREAM)
        node.create_subscription(Bool, LOCK_STEP, self._on_lock_step, LATCHED)

    def begin(self, since: float) -> None:
        """Begin a goal: only what is received from this monotonic time on is seen."""
        self._since, self.frame_id = since, ''
        self._seen: Observation | None = None
        self._shown: np.ndarray | None = None  # its picture, of the camera's size
        self._publishers = publishers_of(self._node, *self._names.values())

    def look(self) -> tuple[Observation | None, str]:
        """
        Return what was seen last.

        :return: Observation, or None when nothing was; which sensors are silent, '' if none is.
        :raises TapError: for messages that cannot be used.
        """
        publishers = publishers_of(self._node, *self._names.values(), LOCK_STEP)
        pacers = publishers.pop(self._node.resolve_topic_name(LOCK_STEP)).keys()
        if rival := rivals(publishers, self._publishers):
            raise PlanningError(
                f'the scene has changed: {rival}; leave one, and send the goal again')
        if cameras := rivals({name: publishers[name] for key, name in self._full.items()
                              if key in ('image', 'mask')}):
            return None, f'{cameras}; leave one of them'  # one may have ended just now
        found, missing = self._newest(*self.topics[:-1], since=self._since), self._missing()
        if found is None:
            return None, missing or self._unmatched_joints() or (
                f'no messages of the same stamp on {self.sensors.names(self.topics)} since the '
                'goal was accepted')
        moment, gripper, received = found
        jumps, (begun_ns, begun_jumps) = self.sensors.jumps, self._episode
        if self._seen is None or (self._seen.stamp_ns, self._seen.jumps) != (
                moment.stamp_ns, jumps):
            self._seen = self._decode(moment, gripper)
            self.frame_id = moment.messages['image'].header.frame_id
        # Nothing ages where what moves the arm waits for commands, and says so itself.
        if self._lock_step and pacers and pacers <= publishers[self._full['joints']].keys():
            received = math.inf
        known = begun_jumps == jumps and begun_ns <= moment.stamp_ns + JUMP_NS
        self._seen = replace(
            self._seen, received=received, scene_ns=begun_ns if known else 0, jumps=jumps)
        return self._seen, missing

    def newest_picture(self) -> tuple[int, int]:
        """Return stamp and age, ns, of the newest picture that has come with its joints."""
        found = self._newest('image')
        if found is None:
            return -1, 0
        return found[0].stamp_ns, int(1e9 * (time.monotonic() - found[2]))

    def cut(self, picture: np.ndarray, name: str) -> np.ndarray:
        """
        Return what the planner makes of a picture, uint8 (H, W, 3).

        :param name: how errors call it.
        :raises ImageError: for one that cannot be cut as in the training.
        """
        crop = self._crop()
        return check_image(crop.of(picture.shape[:2], name).image(picture), name, crop.size)

    def sharp(self, seen: Observation) -> np.ndarray:
        """Return the part of the camera's picture that an Observation shows, see `part`."""
        if self._shown is None or self._seen is None or self._seen.image is not seen.image:
            return seen.image
        return self.part(self._shown, self._names['image'])

    def part(self, picture: np.ndarray, name: str) -> np.ndarray:
        """Return what `cut` does, not made smaller where it is a square of the picture."""
        part = self._crop().unscaled(picture.shape[:2], name).image(picture)
        return part if part.shape[0] == part.shape[1] else self.cut(picture, name)

    def decode_positions(
            self, message: ObjectStates, name: str,
            size: tuple[int, int] | None = None) -> tuple[tuple[str, ...], np.ndarray]:
        """
        Decode where objects are, in the pixels that the planner works with.

        :param message: tap_msgs/ObjectStates, in pixels of a picture.
        :param name: how errors call it.
        :param size: of the picture (H, W); None: of the one that was seen last.
        :return: names, and pixels (K, 2) float32.
        :raises TapError: see objects.decode_objects; also for a pixel outside of the used part.
        """
        size = size or self._camera_size or self._crop().size
        return decode_cut_objects(message, name, size, self._crop().of(size, name))

    def _newest(self, *topics: str, since: float = -math.inf,
                ) -> tuple[Moment, np.ndarray, float] | None:
        """Return the newest Moment whose gripper is known, that, and when all was received."""
        for moment in self.sensors.moments(*topics, since=since):
            with suppress(KinematicsError):
                gripper, received = self._gripper.at(
                    moment.stamp_ns, self._params['max_silence'])
                if received >= since:
                    return moment, gripper, min(moment.received, received)
        return None

    def _missing(self) -> str:
        """Return which sensors are silent and why, '' if none is."""
        ages = self.sensors.ages(self.topics, time.monotonic())
        never = [topic for topic, age in ages.items() if age == math.inf]
        silent = never or [
            topic for topic, age in ages.items() if age > self._params['max_silence']]
        if 'joints' in silent and self._joints_error:
            return self._joints_error
        return (f'nothing{"" if never else " new"} has come on '
                f'{self.sensors.names(silent, explained=True)}' if silent else '')

    def _unmatched_joints(self) -> str:
        """Return why the newest picture has no joints, where joints of an arm have come."""
        newest = self.sensors.newest('image')
        if newest is not None and self._gripper.received > -math.inf:
            try:
                self._gripper.at(newest.stamp_ns, self._params['max_silence'])
            except KinematicsError as error:
                return f'{self.sensors.names(["joints"])}: {error}'
        return ''

    def _decode(self, moment: Moment, gripper: np.ndarray) -> Observation:
        """Return an Observation; the objects keep the order in which they were seen first."""
        name, crop, messages = self._names['image'], self._crop(), moment.messages
        picture = self._picture(messages)
        self._camera_size = picture.shape[:2]
        if crop.crop and crop.camera_size and crop.camera_size != self._camera_size:
            # The model knows where the table is in the pictures of one camera.
            raise ImageError('{0}: pictures of {2}x{1} pixels; the forward model was trained on '
                             'those of {4}x{3}, send such ones'.format(
                                 name, *self._camera_size, *crop.camera_size))
        names, pixels = self.decode_positions(messages['objects'], 'objects')
        states = decode_states(messages['objects'], 'objects')
        if self._seen is not None and set(self._seen.names) == set(names):
            order = [names.index(name) for name in self._seen.names]
            names, pixels = self._seen.names, pixels[order]
            states = tuple(states[k] for k in order) if states else ()
        self._shown = picture
        return Observation(self.cut(picture, name), gripper, names, pixels, moment.stamp_ns,
                           states=states)

    def _picture(self, messages: dict[str, Any]) -> np.ndarray:
        """Return the picture of the camera, without the robot if a mask is used."""
        if self.robot.used:
            return self.robot.see(messages['image'], messages['mask'], self.sensors.jumps)
        return decode_image(messages['image'], self._names['image'])

    # What comes

    def _on_camera(self, name: str) -> None:
        """Remember what the camera sees behind the robot, between goals too."""
        self._on_message(name)
        if self.robot.used and name != self._names['objects'] and (
                moment := self.sensors.newest('image', 'mask')) is not None:
            with suppress(TapError):  # look() reports it
                self._picture(moment.messages)

    def _on_joints(self, message: JointState, info: dict[str, Any]) -> None:
        """Take joint states of the gripper, of the arm, or of another driver."""
        self._on_message(self._names['joints'])
        try:
            if self._gripper.take(message, reception_time(info), self.sensors.time_stands):
                self._joints_error = ''
        except TapError as error:
            self._joints_error = f'{self.sensors.names(["joints"])}: {error}'
            return
        if self._gripper.received > -math.inf:
            self.sensors.note('joints', self._gripper.received)

    def _on_lock_step(self, message: Bool) -> None:
        self._lock_step = message.data

    def _on_episode(self, message: Episode) -> None:
        if message.event == Episode.START:
            self._episode = to_nanoseconds(message.header.stamp), self.sensors.jumps
            self.robot.clear()
            self.sensors.wake()
