# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes masks of a real robot: its URDF, projected into each picture of the camera."""

from collections import deque
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_HAND
from tap_ros.base.errors import ConfigError, ImageError, KinematicsError, TapError
from tap_ros.base.plugins import names
from tap_ros.base.text import escaped
from tap_ros.messages.images import decode_camera_info
from tap_ros.messages.joints import JointHistory
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.robots.arm import DEFAULT_ARM, get_arm, Mount, TIP_FRAME
from tap_ros.robots.description import robot_description
from tap_ros.robots.silhouette import Body, draw_mask, Light, PinholeCamera
from tap_ros.robots.urdf import MOST_CHARACTERS, read_urdf, Robot
from tap_ros.ros.arm_place import ArmPlace
from tap_ros.ros.calls import log_error
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.frames import FixedFrames
from tap_ros.ros.observations import reception_time
from tap_ros.ros.parameters import CameraParameters, declared_mount, Parameters, setting
from tap_ros.ros.subscriptions import (
    adapt_regularly,
    AdaptiveSubscription,
    publishers_of,
    rivals,
    steady_timer,
)
from tap_ros.ros.topics import encode_mask, LATCHED, STREAM

WAITING = 100  # pictures that may wait for their joint states


class RobotMaskNode(Node):
    """
    Answers each camera/camera_info, which comes with every picture, with a mask of its stamp.

    Joints are taken between the joint states before and after the picture, so a mask waits for the
    next joint state. Where the joints, the robot or the camera are not known there is no mask, and
    log and diagnostics have the reason; nodes that use masks ignore the picture.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('robot_mask_node', **options)
        self.params = declare_parameters(self)
        self._light = declared_light(self.params)
        self._camera = self.params.camera_pose()  # at the base itself there is none: as tf tells
        self._frames = FixedFrames(self)
        self._place = ArmPlace(self, self.params, self._frames)
        # CameraInfo of pictures that have no mask yet, and when they were taken.
        self._waiting: deque[tuple[CameraInfo, float]] = deque(maxlen=WAITING)
        self._robot: Robot | None = None
        self._diagnostics = Diagnostics(
            self, ['camera/camera_info', 'joint_states'], ['robot_description'],
            expected=[] if self.params['urdf'] else ['robot_description'])
        self._masks = self.create_publisher(Image, 'camera/robot_mask', STREAM)
        subscriptions = [
            AdaptiveSubscription(self, JointState, 'joint_states', self._on_joints, STREAM),
            AdaptiveSubscription(
                self, CameraInfo, 'camera/camera_info', self._on_camera_info, STREAM)]
        self._stands = declared_mount(self.params)  # of a named arm
        robot = named_robot(self.params, self._stands)
        if robot is not None:
            self._use(robot)
        else:
            subscriptions.append(AdaptiveSubscription(
                self, String, 'robot_description', self._on_description, LATCHED))
        adapt_regularly(self, subscriptions)
        steady_timer(self, 0.2, self._answer_waiting)
        self.get_logger().info(f'ready: {self.params["urdf"] or "waits for robot_description"}')

    def close(self) -> None:
        """Do nothing: there is nothing to finish."""

    def _use(self, robot: Robot) -> None:
        """
        Draw this robot from now on.

        :raises ConfigError: when it lacks the links that the parameters name.
        """
        named = self.params['urdf'] in names('tap_ros.arms')
        hand_link = self.params['hand_link'] or (TIP_FRAME if named else '')
        hand = robot.held_by(hand_link) if hand_link else set()
        self._base = self.params['base_frame'] or robot.links[0]
        robot.held_by(self._base)
        self._labels = [ROBOT_MASK_HAND if shape.link in hand else ROBOT_MASK_ARM
                        for shape in robot.shapes]
        prefix = self.params['joint_prefix']
        self._history = JointHistory([prefix + name for name in robot.positions])
        self._robot = robot

    def _on_description(self, message: String) -> None:
        self._diagnostics.received('robot_description')
        try:
            self._use(read_urdf(message.data, 'robot_description'))
        except TapError as error:
            self._report(error)

    def _on_joints(self, message: JointState, info: dict[str, Any]) -> None:
        self._diagnostics.received('joint_states')
        if self._robot is None:
            return
        try:
            if self._history.add(message, reception_time(info)):
                self._answer_waiting()
        except TapError as error:
            self._report(f'joint_states: {error}')

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._diagnostics.received('camera/camera_info')
        # From now on: while it stayed in the queue, its joints did, too.
        self._waiting.append((message, time.monotonic()))
        self._answer_waiting()

    def _answer_waiting(self) -> None:
        """Publish the masks of all pictures whose joints are known by now."""
        for picture in list(self._waiting):
            info, taken = picture
            try:
                mask = self._mask(info)
                self._masks.publish(encode_mask(mask, info.header.stamp, info.header.frame_id))
            except TapError as error:
                waited = time.monotonic() - taken
                if isinstance(error, KinematicsError) and waited <= self.params['max_silence']:
                    continue  # joints may come
                self._report(error)
            except Exception as error:  # it costs this picture
                self._diagnostics.error(error)
                log_error(self, 'robot mask', error)
            self._waiting.remove(picture)

    def _mask(self, info: CameraInfo) -> np.ndarray:
        """
        Draw the mask of a picture.

        :raises KinematicsError: when robot or joints are not known for its time.
        :raises ImageError: for a camera that cannot be used.
        """
        begin = time.perf_counter()
        if self.params['urdf'] in names('tap_ros.arms') and (
                stands := self._place.usual()) != self._stands and (
                named := named_robot(self.params, stands)):
            self._use(named)
            self._stands = stands
        robot = self._robot
        cameras = rivals(publishers_of(self, 'camera/camera_info'))
        if cameras:
            raise ImageError(f'{cameras}; leave one of them')
        if robot is None:
            raise KinematicsError('nothing that can be used has come on robot_description; name a '
                                  'file by the parameter urdf')
        K, size = decode_camera_info(info, self.params['rectified'])
        found = self._history.at(to_nanoseconds(info.header.stamp), self.params['max_silence'])
        poses = robot.poses(dict(zip(robot.positions, found.positions)))
        to_base = np.linalg.inv(poses[self._base])
        bodies = []
        for shape, label in zip(robot.shapes, self._labels):
            pose = to_base @ poses[shape.link]
            bodies.append(Body(shape.corners @ pose[:3, :3].T + pose[:3, 3], label))
        view = PinholeCamera(K, size, self._camera_in_base(info.header.frame_id))
        mask = draw_mask(bodies, view, self.params['dilation'], self._light)
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'mask')
        return mask

    def _camera_in_base(self, frame: str) -> np.ndarray:
        """Return the pose (4, 4) of a camera, by parameters or tf; ImageError without any."""
        if self._camera[:3, 3].any():
            return self._camera
        pose = self._frames.pose(frame, self._base)
        if pose is None:
            raise ImageError(
                f'nothing tells where the camera is: set camera_x to camera_qw, or publish on '
                f'tf_static where {escaped(frame)!r} is in {escaped(self._base)}; that needs the '
                'package tf2_msgs here, too')
        return pose

    def _report(self, error: object) -> None:
        """Log why a picture has no mask, at most every 5 s."""
        self._diagnostics.error(error)
        self.get_logger().error(
            f'no robot mask: {escaped(error, 1000)}', throttle_duration_sec=5.0)


@dataclass(frozen=True)
class RobotMaskParameters:
    """
    Parameters that this node alone has.

    :param urdf: Shape of the robot: a URDF file; the name of an arm: that arm, at mount_x and so
        on; empty: the topic robot_description.
    :param hand_link: Link that is the hand, with all that it carries; empty: there is none, or
        with a named arm its own.
    :param hand_radius: With a named arm: radius of a cylinder around the hand, from the flange to
        the fingertips, m.
    :param base_frame: Link of the robot in which the pose of the camera is given; empty: its root.
    :param dilation: Pixels by which the mask is larger than the shapes on all sides.
    :param shadow: Mark the shadow on the table, too, as of one light from afar.
    :param table_height: z of the table in base_frame, m.
    :param light_x: x of the direction in which the light shines, in base_frame.
    :param light_y: y of the direction in which the light shines, in base_frame.
    :param light_z: z of the direction in which the light shines, in base_frame.
    :param max_silence: Seconds; a picture without joint states nearer to it than this gets no
        mask.
    """

    urdf: str = ''
    hand_link: str = ''
    hand_radius: float = setting(0.06, between=(0.001, 1.0))
    base_frame: str = ''
    dilation: float = setting(1.0, between=(0.0, 100.0), read_only=False)
    shadow: bool = False
    table_height: float = setting(0.0, between=(-10.0, 10.0))
    light_x: float = setting(0.0, between=(-100.0, 100.0))
    light_y: float = setting(0.0, between=(-100.0, 100.0))
    light_z: float = setting(-1.0, between=(-100.0, 100.0))
    max_silence: float = setting(0.35, between=(0.05, 60.0), read_only=False)


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_shared('joint_prefix')
    parameters.declare_fields(RobotMaskParameters)
    parameters.declare_fields(CameraParameters)
    named = parameters['urdf'] in names('tap_ros.arms')
    parameters.declare_mount(parameters['urdf'] if named else DEFAULT_ARM)
    return parameters


def named_robot(parameters: Parameters, mount: Mount) -> Robot | None:
    """
    Return the robot that the parameter urdf names, None where it comes as a message.

    :param mount: of an arm that is named.
    :raises ConfigError: when the file cannot be used.
    """
    urdf = parameters['urdf']
    if not urdf:
        return None
    if urdf in names('tap_ros.arms'):
        text = robot_description(
            get_arm(urdf), mount, parameters['hand_radius'])
        return read_urdf(text, urdf)
    path = Path(urdf)
    try:
        if not path.is_file() or path.stat().st_size > MOST_CHARACTERS:
            raise ConfigError(f'parameter urdf: {escaped(urdf)} is no file of at most '
                              f'{MOST_CHARACTERS} bytes; expected a URDF, or '
                              f'one of {", ".join(names("tap_ros.arms"))}')
        return read_urdf(path.read_text('utf-8', 'replace'), escaped(urdf))
    except (OSError, ValueError) as error:
        raise ConfigError(f'parameter urdf: {escaped(urdf)}: {escaped(error)}') from error


def declared_light(parameters: Parameters) -> Light | None:
    """
    Return the light whose shadows are marked, if they are.

    :raises ConfigError: for a light that does not shine down.
    """
    if not parameters['shadow']:
        return None
    direction = np.array([parameters[f'light_{axis}'] for axis in 'xyz'])
    if direction[2] >= 0:
        raise ConfigError(f'parameter light_z: is {direction[2]:g}; expected less than 0: light '
                          'shines down')
    return Light(direction, parameters['table_height'])
