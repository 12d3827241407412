# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What tracker_node sees: pictures of camera and goal, their calibration, scenes, clicks."""

from collections.abc import Callable, Sequence
from contextlib import suppress
import math
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, JointState
from tap_msgs.msg import Episode
from tap_msgs.srv import SelectObjects
from tap_ros.base.contract import WORLD_FRAME
from tap_ros.base.errors import ImageError, KinematicsError, TapError, TrackingError
from tap_ros.images.robot_mask import hidden_pixels
from tap_ros.messages.images import decode_camera_info, decode_image, decode_mask
from tap_ros.messages.joints import GripperHistory
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import CAMERA_INFO, CAMERA_POSE, JOINT_STATES
from tap_ros.robots.arm import get_arm
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.ros.arm_place import ArmPlace
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.frames import FixedFrames
from tap_ros.ros.observations import JUMP_NS, Moment, Observations, reception_time
from tap_ros.ros.parameters import Parameters, pose_matrix
from tap_ros.ros.subscriptions import adapt_regularly, AdaptiveSubscription, publishers_of
from tap_ros.ros.topics import camera_topics, goal_topics, LATCHED, STREAM
from tap_ros.tracking.plane import check_pose, Plane
from tap_ros.tracking.protocols import Tracked, Tracker, View

MOST_POINTS = 1000  # of an outline; OpenCV fills one of 100 000 for minutes

class TrackerInputs:
    """
    Pictures, joints and calibration, from topics and parameters.

    :param params: Parameters of the node.
    :param idle: called without arguments, returns why nothing is followed, '' if something is.
    :param on_episode: called without arguments when an episode has begun.
    :ivar sensors: Observations of the camera; goals: of the goal.
    :ivar diagnostics: Diagnostics of the node.
    """

    def __init__(self, node: Node, params: Parameters, idle: Callable[[], str],
                 on_episode: Callable[[], object]) -> None:
        self._node, self._params, self._on_begin = node, params, on_episode
        self._mounted = params.camera_pose() if params['camera_z'] else None
        if self._mounted is not None:
            check_pose(self._mounted)
        self.info: CameraInfo | None = None
        self.pose: PoseStamped | None = None  # of the camera, as a topic tells
        self._frames = FixedFrames(node)
        self.episode = 0, 0  # stamp at which the newest known of began; jumps until then
        self._gripper = GripperHistory(
            get_arm(params['arm']), params['joint_prefix'], params['fixed_opening'],
            ArmPlace(node, params, self._frames).mount)
        camera, goal = camera_topics(params), goal_topics(params['robot_mask'])
        del camera['objects'], goal['objects']
        self._topics, self._image_topic = tuple(camera), camera['image'][1]
        self.diagnostics = Diagnostics(
            node, [name for _, name in camera.values()],
            [CAMERA_INFO.name, JOINT_STATES.name, *(name for _, name in goal.values())],
            idle=idle)
        self.sensors, self.goals = Observations(*camera), Observations(*goal, latched=True)
        self.sensors.subscribe(node, camera, STREAM, on_message=self.diagnostics.received)
        self.goals.subscribe(node, goal, LATCHED, on_message=self._on_goal)
        adapt_regularly(node, [
            AdaptiveSubscription(node, CameraInfo, CAMERA_INFO.name, self._on_info, STREAM),
            AdaptiveSubscription(node, PoseStamped, CAMERA_POSE.name, self._on_pose, LATCHED),
            AdaptiveSubscription(node, JointState, JOINT_STATES.name, self._on_joints, STREAM),
            AdaptiveSubscription(node, Episode, 'episode', self._on_episode, STREAM)])

    # What comes

    def _on_goal(self, topic: str) -> None:
        self.diagnostics.received(topic)
        self.sensors.wake()

    def _on_info(self, message: CameraInfo) -> None:
        self.diagnostics.received(CAMERA_INFO.name)
        self.info = message

    def _on_pose(self, message: PoseStamped) -> None:
        self.pose = message

    def _on_joints(self, message: JointState, info: dict[str, Any]) -> None:
        self.diagnostics.received(JOINT_STATES.name)
        with suppress(TapError):  # then the gripper is not known, which a tracker can do without
            self._gripper.take(message, reception_time(info), self.sensors.time_stands)
        self.sensors.wake()

    def _on_episode(self, message: Episode) -> None:
        if message.event != Episode.START:
            return
        begun_ns, newest = to_nanoseconds(message.header.stamp), self.sensors.newest('image')
        if newest is not None and begun_ns > newest.stamp_ns + JUMP_NS:
            begun_ns = newest.stamp_ns + 1  # of another clock: it begins with the next picture
        self.episode = begun_ns, self.sensors.jumps
        self._on_begin()

    # What is seen

    def publishers(self) -> dict[str, dict[bytes, set[str]]]:
        """Return who publish the camera's pictures: another one is another camera."""
        return publishers_of(self._node, self._image_topic)

    def newest(self) -> Moment | None:
        """Return the newest picture of the camera, with its mask where one is used."""
        return self.sensors.newest(*self._topics)

    def clicked(self, asked_ns: int) -> tuple[Moment, View]:
        """
        Return the newest picture.

        :param asked_ns: stamp of the one that was clicked, or 0.
        :raises TrackingError: where there is none of this scene, or none so new.
        """
        moment = self.newest()
        if moment is None:
            missing = self.sensors.missing(self._topics)
            raise TrackingError(
                f'nothing has come on {self.sensors.names(missing, explained=True)}' if missing
                else f'no messages of the same stamp on {self.sensors.names(self._topics)}')
        if moment.stamp_ns < max(asked_ns, self.scene_ns()):
            raise TrackingError('no picture of the new episode has come yet; click again')
        return moment, self.view(moment)

    def view(self, moment: Moment) -> View:
        """Return what a picture of the camera shows, with the gripper where it is known by now."""
        picture = decode_image(moment.messages['image'], 'camera/image_raw')
        return View(picture, self._mask(moment, 'camera/robot_mask', picture),
                    self._hand(moment.stamp_ns))

    def goal_view(self, goal: Moment, size: tuple[int, int]) -> View:
        """Return what a goal picture shows; ImageError for one of another size."""
        picture = decode_image(goal.messages['image'], 'goal/image', size)
        return View(picture, self._mask(goal, 'goal/robot_mask', picture))

    def lacks_joints(self, moment: Moment) -> bool:
        """Return whether the joints of a picture may still come."""
        return (self._gripper.received > -math.inf and self._hand(moment.stamp_ns) is None
                and time.monotonic() - moment.received < self._params['patience'])

    def scene_ns(self) -> int:
        """Return when the scene of the newest picture began, 0 if no mark of its clock says."""
        (begun_ns, jumps), newest = self.episode, self.sensors.newest('image')
        known = newest is not None and begun_ns <= newest.stamp_ns + JUMP_NS
        return begun_ns if known and jumps == self.sensors.jumps else 0

    def calibration(self, size: tuple[int, int]) -> tuple[Plane | None, PinholeCamera | None]:
        """
        Return the calibrated camera for pictures of a size (height, width); None without a pose.

        The pose is that of the parameters, else of camera/pose, as the simulator tells it, else
        that of the frame of camera_info by tf.

        :raises TapError: for a pose of no use, and for a camera_info that is missing, or not that
            of these pictures.
        """
        pose = self._told_pose() if self._mounted is None else self._mounted
        if pose is None:
            return None, None
        if self.info is None:
            raise ImageError('the pose of the camera is known, and nothing has come on '
                             'camera/camera_info; publish it')
        K, found = decode_camera_info(self.info, self._params['rectified'])
        if found != size:
            raise ImageError('camera/camera_info: is of pictures of {1}x{0} pixels; they have '
                             '{3}x{2}'.format(*found, *size))
        camera = PinholeCamera(K, size, pose)
        return Plane(camera, size), camera

    def _told_pose(self) -> np.ndarray | None:
        """Return the pose (4, 4) of the camera as topics tell it, None if none does."""
        source, pose = CAMERA_POSE.name, None
        try:
            if self.pose is not None:
                told = self.pose.pose
                pose = pose_matrix([getattr(told.position, axis) for axis in 'xyz'],
                                   [getattr(told.orientation, axis) for axis in 'xyzw'])
            elif self.info is not None:
                source = 'tf_static'
                pose = self._frames.pose(self.info.header.frame_id, WORLD_FRAME)
            if pose is not None:
                check_pose(pose)
        except TapError as error:
            raise TrackingError(f'{source}: {error}') from error
        return pose

    def _hand(self, stamp_ns: int) -> np.ndarray | None:
        """Return the gripper's state (4,) at the time of a picture, None if it is not known."""
        with suppress(KinematicsError):
            return self._gripper.at(stamp_ns, self._params['max_silence'])[0]
        return None

    def _mask(self, moment: Moment, name: str, picture: np.ndarray) -> np.ndarray | None:
        """Return the robot mask of a picture, None where there is none."""
        if 'mask' not in moment.messages:
            return None
        mask = decode_mask(moment.messages['mask'], name, picture.shape[:2])
        return np.where(hidden_pixels(mask, self._params['robot_mask']), mask, 0)


def drawn_in(request: SelectObjects.Request) -> list[np.ndarray]:
    """Return the outlines (N, 2) of a request; TrackingError for those that are none."""
    if any(len(polygon.points) > MOST_POINTS for polygon in request.drawn):
        raise TrackingError(f'drawn: expected {MOST_POINTS} points at most of an outline')
    drawn = [np.array([(point.x, point.y) for point in polygon.points]).reshape(-1, 2)
             for polygon in request.drawn]
    if len(drawn) not in (0, len(request.names)) or not all(
            np.isfinite(line).all() and len(line) not in (1, 2) for line in drawn):
        raise TrackingError('drawn: expected no polygons, or one for each name, each empty or of '
                            'three points and more, which are finite numbers')
    return drawn


def select(tracker: Tracker, view: View, clicks: np.ndarray, drawn: Sequence[np.ndarray]
           ) -> tuple[list[int], dict[int, TrackingError], Tracked]:
    """
    Follow what is clicked.

    :return: which clicks are on objects, why others are refused, and where the objects are.
    :raises TrackingError: where all are refused.
    """
    kept, why = list(range(len(clicks))), dict[int, TrackingError]()
    with suppress(TrackingError):
        return kept, why, tracker.select(view, clicks, *_picked(drawn, kept))
    for k in kept:
        try:
            tracker.select(view, clicks[[k]], *_picked(drawn, [k]))
        except TrackingError as error:
            why[k] = error
    if len(why) == len(clicks):
        raise next(iter(why.values()))
    kept = [k for k in kept if k not in why]
    return kept, why, tracker.select(view, clicks[kept], *_picked(drawn, kept))


def _picked(drawn: Sequence[np.ndarray], kept: Sequence[int]) -> tuple[list[np.ndarray], ...]:
    """Return what select is given beside clicks: some trackers know no outlines."""
    return ([drawn[k] for k in kept],) if drawn else ()
