# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs of visual_mpc_node: messages grouped by their stamp, and decoded once."""

from collections.abc import Callable, Collection
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
from tap_ros.ros.observations import JUMP_NS, Observations, reception_time
from tap_ros.ros.parameters import declared_arm, Parameters
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
    :ivar topics: short names of what is looked at.
    :ivar sensors: Observations.
    :ivar robot: RobotView.
    :ivar frame_id: of the picture that was seen last.
    """

    def __init__(self, node: Node, params: Parameters, crop: Callable[[], TrainedCrop],
                 on_message: Callable[[str], object]) -> None:
        self._node, self._params, self._crop = node, params, crop
        self._camera_size: tuple[int, int] | None = None
        self._mark = 0, 0  # that an episode begins: stamp, and jumps of the clock until then
        self.robot = RobotView(params['robot_mask'])
        self._types = {**camera_topics(params), 'joints': of_topic(JOINT_STATES)}
        self.topics = tuple(self._types)
        self._names = [name for _, name in self._types.values()]
        self._cameras = [name for topic, (_, name) in self._types.items()
                         if topic in ('image', 'mask')]
        self._tell = on_message
        self.sensors = Observations(*self._types)
        self._gripper = GripperHistory(
            declared_arm(params), params['joint_prefix'], params['fixed_opening'])
        self._useless = ''  # why the joint states cannot be used
        self.begin(0.0)
        self.sensors.subscribe(node, self._types, STREAM, on_message=self._on_message,
                               others={'joints': self._on_joints})
        node.create_subscription(Episode, 'episode', self._on_episode, STREAM)
        self._told_lock_step = False
        node.create_subscription(Bool, LOCK_STEP, self._on_lock_step, LATCHED)

    def begin(self, since: float) -> None:
        """Begin a goal: only what is received from this monotonic time on is seen."""
        self._since = since
        self._seen: Observation | None = None
        self.frame_id = ''
        self._publishers = publishers_of(self._node, self._names)

    def look(self) -> tuple[Observation | None, str]:
        """
        Return what was seen last.

        :return: Observation, or None when nothing was; which sensors are silent, '' if none is.
        :raises TapError: for messages that cannot be used.
        """
        rival = rivals(self._node, self._names, self._publishers)
        if rival:
            raise PlanningError(
                f'the scene has changed: {rival}; leave one, and send the goal again')
        cameras = rivals(self._node, self._cameras)
        if cameras:  # one may have ended just now
            return None, f'{cameras}; leave one of them'
        topics = self.topics
        moment = self.sensors.newest(*topics, since=self._since)
        missing = self._lacking(topics)
        if moment is None:
            return None, missing or self._unmatched_joints() or (
                f'no messages of the same stamp on {self.sensors.names(topics)} since the goal '
                'was accepted')
        times: dict[str, Any] = {
            'received': math.inf if self._lock_step else moment.received,
            'scene_ns': self._scene_ns(moment.stamp_ns),
            'jumps': self.sensors.jumps}
        if self._seen is not None and (self._seen.stamp_ns, self._seen.jumps) == (
                moment.stamp_ns, times['jumps']):
            self._seen = replace(self._seen, **times)
        else:
            self._seen = self._decode(moment.messages, moment.stamp_ns, times)
            self.frame_id = moment.messages['image'].header.frame_id
        return self._seen, missing

    @property
    def _lock_step(self) -> bool:
        """Tell whether what moves the arm waits for commands, so that nothing ages."""
        if not self._told_lock_step:
            return False
        tellers, arms = publishers_of(
            self._node, [LOCK_STEP, self._types['joints'][1]]).values()
        return bool(tellers) and tellers.keys() <= arms.keys()

    def newest_stamp(self) -> int:
        """Return the stamp of the newest picture that has come with its joints, in ns."""
        moment = self.sensors.newest('image', 'joints')
        return moment.stamp_ns if moment is not None else -1

    def _scene_ns(self, stamp_ns: int) -> int:
        """Return when the scene began, 0 if that is unknown or of another clock."""
        begun_ns, jumps = self._mark
        known = jumps == self.sensors.jumps and begun_ns <= stamp_ns + JUMP_NS
        return begun_ns if known else 0

    def _picture(self, messages: dict[str, Any]) -> np.ndarray:
        """Return the picture of the camera, without the robot if a mask is used."""
        if self.robot.used:
            return self.robot.see(messages['image'], messages['mask'], self.sensors.jumps)
        return decode_image(messages['image'], self._types['image'][1])

    def cut(self, picture: np.ndarray, name: str) -> np.ndarray:
        """
        Return a picture, uint8 (H, W, 3), as the planner sees it.

        :param name: how errors call it.
        :raises ImageError: for one that cannot be cut as in the training.
        """
        crop = self._crop()
        return check_image(crop.of(picture.shape[:2], name).image(picture), name, crop.size)

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

    def _on_joints(self, message: JointState, info: dict[str, Any]) -> None:
        """Take joint states of the gripper, of the arm, or of another driver."""
        received, name = reception_time(info), self._types['joints'][1]
        self._tell(name)
        try:
            if self._gripper.take(message, received, self.sensors.time_stands):
                self._useless = ''
        except TapError as error:
            self._useless = f'{self.sensors.names(["joints"])}: {error}'
            return
        if self._gripper.received > -math.inf:
            self.sensors.note('joints', self._gripper.received)
            newest = self.sensors.newest('image')  # again, as joints that come again are newer
            for stamp_ns in {*self.sensors.without('joints', 'image'),
                             *([newest.stamp_ns] if newest else [])}:
                self._match_joints(stamp_ns)

    def _match_joints(self, stamp_ns: int) -> None:
        """Add the gripper's state at the time of a picture, once the arm's joints are known."""
        with suppress(KinematicsError):  # look() reports it
            self.sensors.attach('joints', stamp_ns, *self._gripper.at(
                stamp_ns, self._params['max_silence']))

    def _unmatched_joints(self) -> str:
        """Return why the newest picture has no joints, where joints of an arm have come."""
        newest = self.sensors.newest('image')
        if self._gripper.received == -math.inf or newest is None:
            return ''
        try:
            self._gripper.at(newest.stamp_ns, self._params['max_silence'])
        except KinematicsError as error:
            return f'{self.sensors.names(["joints"])}: {error}'
        return ''

    def _on_message(self, name: str) -> None:
        """Remember what the camera sees behind the robot, between goals too."""
        self._tell(name)
        if name == self._types['image'][1]:
            newest = self.sensors.newest('image')
            if newest is not None:
                self._match_joints(newest.stamp_ns)  # again, if the picture was sent again
        if not self.robot.used or name not in (self._types['image'][1], self._types['mask'][1]):
            return
        moment = self.sensors.newest('image', 'mask')
        if moment is not None:
            with suppress(TapError):  # look() reports it
                self._picture(moment.messages)

    def _decode(self, messages: dict[str, Any], stamp_ns: int,
                times: dict[str, Any]) -> Observation:
        """Return an Observation; the objects keep the order in which they were seen first."""
        name, crop = self._types['image'][1], self._crop()
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
        return Observation(self.cut(picture, name), messages['joints'], names, pixels, stamp_ns,
                    states=states, **times)

    def _lacking(self, topics: Collection[str]) -> str:
        """Return which sensors are silent and why, '' if none is."""
        missing, ages = self.sensors.missing(topics), self.sensors.ages(topics, time.monotonic())
        silent = missing or [
            topic for topic in topics if ages[topic] > self._params['max_silence']]
        if 'joints' in silent and self._useless:
            return self._useless
        what = 'nothing' if missing else 'nothing new'
        return (f'{what} has come on {self.sensors.names(silent, explained=True)}'
                if silent else '')

    def _on_lock_step(self, message: Bool) -> None:
        self._told_lock_step = message.data

    def _on_episode(self, message: Episode) -> None:
        if message.event == Episode.START:
            self._mark = to_nanoseconds(message.header.stamp), self.sensors.jumps
            self.robot.clear()
            self.sensors.wake()
