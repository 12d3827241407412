# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Follows objects that were clicked once in the camera's pictures: objects and goal/objects."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import math
import threading
import time
from typing import Any

from geometry_msgs.msg import Point32, Polygon, PoseStamped
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, JointState
from tap_msgs.msg import Episode, ObjectStates
from tap_msgs.srv import SelectObjects
from tap_ros.base.contract import WORLD_FRAME
from tap_ros.base.errors import ImageError, KinematicsError, TapError, TrackingError
from tap_ros.base.plugins import load_plugin, names
from tap_ros.base.text import escaped, listing
from tap_ros.images.robot_mask import hidden_pixels
from tap_ros.messages.images import decode_camera_info, decode_image, decode_mask, is_empty
from tap_ros.messages.joints import GripperHistory
from tap_ros.messages.objects import decode_objects, MAX_OBJECTS
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import CAMERA_INFO, CAMERA_POSE, JOINT_STATES
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.observations import JUMP_NS, Moment, Observations, reception_time
from tap_ros.ros.parameters import declared_arm, Parameters, pose_matrix
from tap_ros.ros.ros_messages import encode_objects
from tap_ros.ros.services import answering, log_error
from tap_ros.ros.subscriptions import (
    adapt_regularly,
    AdaptiveSubscription,
    publishers_of,
    rivals,
)
from tap_ros.ros.topics import camera_topics, goal_topics, LATCHED, SERVICE_QOS, STREAM
from tap_ros.tracking.plane import check_pose, MIDDLE, Plane
from tap_ros.tracking.protocols import HIDDEN, LOST, SEEN, Tracked, Tracker, View
from tap_ros.tracking.registration import propose

MOVED = 2.0  # px of the working picture by which the table has moved in that of another camera


@dataclass(frozen=True)
class Selection:
    """Objects that are followed, and what was said of them last."""

    names: tuple[str, ...]  # K
    tracker: Tracker
    plane: Plane | None  # None: the camera is not calibrated
    size: tuple[int, int]  # (height, width) of its pictures
    selected_ns: int  # stamp of the picture in which they were clicked
    jumps: int  # of the clock of the stamps until then
    publishers: Mapping[str, Mapping[bytes, set[str]]]  # of each topic then
    stamp_ns: int  # of the newest picture in which they were followed
    received: float  # s, monotonic: when that picture was received
    tracked: Tracked
    message: ObjectStates | None  # of that picture; None: they could not be followed in it
    goal_ns: int | None = None  # stamp of the goal picture in which they were searched


class TrackerNode(Node):
    """
    Follows the objects of the last select_objects, and finds them in the goal picture.

    A thread of its own does, and takes the newest picture whenever it is done with one. A picture
    that is sent again while time stands still, as in lock-step, is answered again.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('tracker_node', **options)
        self.params = declare_parameters(self)
        self._make = load_plugin('tap_ros.trackers', self.params['tracker'])
        self._mounted = self.params.camera_pose() if self.params['camera_z'] else None
        if self._mounted is not None:
            check_pose(self._mounted)
        self._lock = threading.RLock()  # of what follows
        self._selection: Selection | None = None
        self._info: CameraInfo | None = None
        self._told: PoseStamped | None = None  # where the camera is
        self._begun = 0, 0  # stamp at which the newest scene known of began; jumps until then
        self._told_goal: int | None = None  # stamp of the goal whose objects were told
        self._gripper = GripperHistory(
            declared_arm(self.params), self.params['joint_prefix'], self.params['fixed_opening'])
        camera = camera_topics(self.params)
        self._own_topics = [camera['image'][1]]  # another camera sends pictures
        del camera['objects']
        goal = goal_topics(self.params['robot_mask'])
        del goal['objects']
        self._diagnostics = Diagnostics(
            self, [name for _, name in camera.values()],
            [CAMERA_INFO.name, JOINT_STATES.name, *(name for _, name in goal.values())],
            idle=self._why_not)
        received = self._diagnostics.received
        self._topics = tuple(camera)
        self._sensors, self._goals = Observations(*camera), Observations(*goal, latched=True)
        self._objects = self.create_publisher(ObjectStates, 'objects', STREAM)
        self._goal_objects = self.create_publisher(ObjectStates, 'goal/objects', LATCHED)
        self._sensors.subscribe(self, camera, STREAM, on_message=received)
        self._goals.subscribe(self, goal, LATCHED, on_message=self._on_goal)
        adapt_regularly(self, [
            AdaptiveSubscription(self, CameraInfo, CAMERA_INFO.name, self._on_info, STREAM),
            AdaptiveSubscription(self, PoseStamped, CAMERA_POSE.name, self._on_pose, LATCHED),
            AdaptiveSubscription(self, JointState, JOINT_STATES.name, self._on_joints, STREAM),
            AdaptiveSubscription(self, Episode, 'episode', self._on_episode, STREAM)])
        self.create_service(SelectObjects, 'select_objects', answering(self, self._on_select),
                            qos_profile=SERVICE_QOS)
        self._closed = False
        self._thread = threading.Thread(target=self._follow, name='follow', daemon=True)
        self._thread.start()
        self.get_logger().info(f'ready: {self.params["tracker"]}, call select_objects')

    def close(self) -> None:
        """Let the thread end."""
        self._closed = True
        self._sensors.wake()
        self._thread.join(5.0)

    # What comes

    def _on_goal(self, topic: str) -> None:
        self._diagnostics.received(topic)
        self._sensors.wake()

    def _on_info(self, message: CameraInfo) -> None:
        self._diagnostics.received(CAMERA_INFO.name)
        self._info = message

    def _on_pose(self, message: PoseStamped) -> None:
        self._told = message

    def _on_joints(self, message: JointState, info: dict[str, Any]) -> None:
        self._diagnostics.received(JOINT_STATES.name)
        with suppress(TapError):  # then the gripper is not known, which a tracker can do without
            self._gripper.take(message, reception_time(info), self._sensors.time_stands)
        self._sensors.wake()

    def _on_episode(self, message: Episode) -> None:
        if message.event != Episode.START:
            return
        # Known at once to who holds the lock, and searches a picture.
        begun_ns, newest = to_nanoseconds(message.header.stamp), self._sensors.newest('image')
        if newest is not None and begun_ns > newest.stamp_ns + JUMP_NS:
            begun_ns = newest.stamp_ns + 1  # of another clock: it begins with the next picture
        self._begun = begun_ns, self._sensors.jumps
        with self._lock:
            if self._selection is not None and self._ended(self._selection):
                self._forget('a new episode has begun')

    def _on_select(self, request: SelectObjects.Request,
                   response: SelectObjects.Response) -> SelectObjects.Response:
        with self._lock:
            moment, view = self._newest(to_nanoseconds(request.stamp))
            plane, camera = self._calibration(view.image.shape[:2])
            if request.propose:
                tracked = self._propose(view, camera)
                found = [f'object_{k + 1}' for k in range(len(tracked.pixels))]
                response.message = f'{len(found)} things differ in the goal picture'
            else:
                tracked = self._select(request, moment, view, plane, camera)
                found = list(request.names)
                response.message = f'following {listing(found)}'
            response.objects = self._encode(
                found, tracked, plane, moment.messages['image'].header).objects
        response.outlines = [Polygon(points=[
            Point32(x=float(u), y=float(v)) for u, v in outline]) for outline in tracked.outlines]
        response.success = True
        return response

    def _select(self, request: SelectObjects.Request, moment: Moment, view: View,
                plane: Plane | None, camera: PinholeCamera | None) -> Tracked:
        """
        Follow other objects from a picture on.

        :raises TapError: for names or clicks that cannot be used; then nothing changes.
        """
        found, clicks = self._asked(request, view.image.shape[:2])
        cameras = rivals(self, self._own_topics)
        if cameras:
            raise TrackingError(f'{cameras}; leave one of them')
        others = self.count_publishers('objects') - 1
        if others > 0:
            raise TrackingError(
                f'{others} other nodes publish on {self.resolve_topic_name("objects")}; end '
                'them, or start the simulator with objects:=tracked')
        tracker: Tracker = self._make(camera)
        tracked = tracker.select(view, clicks)
        message = self._encode(found, tracked, plane, moment.messages['image'].header)
        self._selection = Selection(
            found, tracker, plane, view.image.shape[:2], moment.stamp_ns, self._sensors.jumps,
            publishers_of(self, self._own_topics), moment.stamp_ns, moment.received,
            tracked, message)
        self._objects.publish(message)
        self._sensors.wake()  # for the goal
        self.get_logger().info(f'following {listing(found)}')
        return tracked

    def _propose(self, view: View, camera: PinholeCamera | None) -> Tracked:
        """
        Return what differs between a picture and the goal picture.

        :raises TapError: without a goal picture, and where nothing differs.
        """
        goal = self._goals.newest('image')
        if goal is None or is_empty(goal.messages['image']):
            raise TrackingError(
                f'nothing has come on {self._goals.names(["image"], explained=True)}; without a '
                'goal picture nothing can be proposed')
        tracker: Tracker = self._make(camera)
        found = []
        for pixel in propose(view, self._goal_view(goal, view.image.shape[:2])):
            with suppress(TrackingError):  # it could not be followed
                tracker.select(view, [pixel])
                found.append(pixel)
        if not found:
            raise TrackingError('the goal picture shows nothing elsewhere; click on each object')
        return tracker.select(view, found)  # for the outlines

    def _asked(self, request: SelectObjects.Request,
               size: tuple[int, int]) -> tuple[tuple[str, ...], np.ndarray]:
        """Return names and clicks (K, 2) of a request; TapError for those that are of no use."""
        if not 1 <= len(request.names) == len(request.u) == len(request.v) <= MAX_OBJECTS:
            raise TrackingError(
                f'names, u and v have {len(request.names)}, {len(request.u)} and '
                f'{len(request.v)} entries; expected as many of each, 1 to {MAX_OBJECTS}')
        clicks = np.column_stack([request.u, request.v])
        asked = encode_objects(request.names, clicks, None, 0, '', ObjectStates.SOURCE_TRACKED)
        return decode_objects(asked, 'select_objects', size)

    # What is known of a picture

    def _newest(self, asked_ns: int) -> tuple[Moment, View]:
        """
        Return the newest picture.

        :param asked_ns: stamp of the one that was clicked, or 0.
        :raises TrackingError: where there is none of this scene, or none so new.
        """
        moment = self._sensors.newest(*self._topics)
        if moment is None:
            missing = self._sensors.missing(self._topics)
            raise TrackingError(
                f'nothing has come on {self._sensors.names(missing, explained=True)}' if missing
                else f'no messages of the same stamp on {self._sensors.names(self._topics)}')
        if moment.stamp_ns < max(asked_ns, self._scene_ns()):
            raise TrackingError('no picture of the new episode has come yet; click again')
        return moment, self._view(moment)

    def _view(self, moment: Moment) -> View:
        """Return what a picture shows, with the gripper where it is known by now."""
        picture = decode_image(moment.messages['image'], 'camera/image_raw')
        return View(picture, self._mask(moment, 'camera/robot_mask', picture),
                    self._hand(moment.stamp_ns))

    def _hand(self, stamp_ns: int) -> np.ndarray | None:
        """Return the gripper's state (4,) at the time of a picture, None if it is not known."""
        with suppress(KinematicsError):
            return self._gripper.at(stamp_ns, self.params['max_silence'])[0]
        return None

    def _goal_view(self, goal: Moment, size: tuple[int, int]) -> View:
        """Return what a goal picture shows; ImageError for one of another size."""
        picture = decode_image(goal.messages['image'], 'goal/image', size)
        return View(picture, self._mask(goal, 'goal/robot_mask', picture))

    def _mask(self, moment: Moment, name: str, picture: np.ndarray) -> np.ndarray | None:
        """Return the robot mask of a picture, None where there is none."""
        if 'mask' not in moment.messages:
            return None
        mask = decode_mask(moment.messages['mask'], name, picture.shape[:2])
        return np.where(hidden_pixels(mask, self.params['robot_mask']), mask, 0)

    def _calibration(self, size: tuple[int, int]) -> tuple[Plane | None, PinholeCamera | None]:
        """
        Return the calibrated camera for pictures of a size (height, width); None without a pose.

        The pose is that of the parameters, else of camera/pose, as the simulator tells it.

        :raises TapError: for a pose of no use, and for a camera_info that is missing, or not that
            of these pictures.
        """
        pose = self._mounted
        if pose is None and self._told is not None:
            told = self._told.pose
            try:
                pose = pose_matrix([getattr(told.position, axis) for axis in 'xyz'],
                                   [getattr(told.orientation, axis) for axis in 'xyzw'])
                check_pose(pose)
            except TapError as error:
                raise TrackingError(f'{CAMERA_POSE.name}: {error}') from error
        if pose is None:
            return None, None
        if self._info is None:
            raise ImageError('the pose of the camera is known, and nothing has come on '
                             'camera/camera_info; publish it')
        K, found = decode_camera_info(self._info, self.params['rectified'])
        if found != size:
            raise ImageError('camera/camera_info: is of pictures of {1}x{0} pixels; they have '
                             '{3}x{2}'.format(*found, *size))
        camera = PinholeCamera(K, size, pose)
        return Plane(camera, size), camera

    # Following

    def _follow(self) -> None:
        """Follow until the node ends; runs in a thread of its own."""
        while not self._closed:
            count = self._sensors.count
            for look in (self._look_at_camera, self._look_at_goal):
                try:
                    with self._lock:
                        if self._selection is not None:
                            look(self._selection)
                except TapError as error:
                    self._diagnostics.error(error)
                    self.get_logger().error(escaped(error, 1000), throttle_duration_sec=5.0)
                except Exception as error:  # this thread must not end
                    self._diagnostics.error(error)
                    log_error(self, 'following', error)
            self._sensors.wait_for_change(0.1, count)

    def _look_at_camera(self, selection: Selection) -> None:
        """Follow the objects in the newest picture."""
        changed = self._other_scene(selection)
        if changed:
            self._forget(changed)
            return
        moment = self._sensors.newest(*self._topics)
        if moment is None or moment.stamp_ns < selection.stamp_ns:
            return
        if moment.stamp_ns == selection.stamp_ns:
            if moment.received > selection.received and selection.message is not None:
                self._objects.publish(selection.message)  # it was sent again
                self._selection = replace(selection, received=moment.received)
            return
        if (self._gripper.received > -math.inf and self._hand(moment.stamp_ns) is None
                and time.monotonic() - moment.received < self.params['patience']):
            return  # its joints may come
        # Whatever fails costs this picture, which is not tried again.
        self._selection = replace(
            selection, stamp_ns=moment.stamp_ns, received=moment.received, message=None)
        view = self._view(moment)
        changed = self._other_camera(selection, view.image.shape[:2])
        if changed:
            self._forget(changed)
            return
        begin = time.perf_counter()
        tracked = selection.tracker.update(view)
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'track')
        message = self._encode(
            selection.names, tracked, selection.plane, moment.messages['image'].header)
        self._objects.publish(message)
        self._tell(selection, tracked)
        self._selection = replace(self._selection, tracked=tracked, message=message)

    def _look_at_goal(self, selection: Selection) -> None:
        """Find the objects in the goal picture, if that is another one."""
        goal = self._goals.newest('image')
        if goal is None or goal.stamp_ns == selection.goal_ns or self._ended(selection):
            return
        masked = self.params['robot_mask'] != 'none' and 'mask' not in goal.messages
        if masked and time.monotonic() - goal.received < self.params['patience']:
            return  # its mask may come
        self._selection = replace(selection, goal_ns=goal.stamp_ns)
        header = goal.messages['image'].header
        if is_empty(goal.messages['image']):  # it was taken back
            self._goal_objects.publish(ObjectStates(header=header))
            return
        begin = time.perf_counter()
        try:
            found = selection.tracker.find(self._goal_view(goal, selection.size))
        except Exception:
            self._goal_objects.publish(ObjectStates(header=header))  # not those of another goal
            raise
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'find')
        if self._ended(selection):
            return  # it may have been the goal of the scene that has begun
        lost = np.array(found.states) == LOST
        # What is not found is to be placed, beginning where it is now.
        pixels = np.where(lost[:, None], selection.tracked.pixels, found.pixels)
        message = self._encode(
            selection.names, replace(found, pixels=pixels), selection.plane, header)
        self._goal_objects.publish(message)
        self._told_goal = goal.stamp_ns
        if lost.any():
            missing = listing([selection.names[k] for k in np.flatnonzero(lost)])
            self.get_logger().warning(f'goal/image: {missing} not found: place it, in the '
                                      'explorer or by goal_objects of reach_goal')

    def _scene_ns(self) -> int:
        """Return when the scene of the newest picture began, 0 if no mark of its clock says."""
        (begun_ns, jumps), newest = self._begun, self._sensors.newest('image')
        known = newest is not None and begun_ns <= newest.stamp_ns + JUMP_NS
        return begun_ns if known and jumps == self._sensors.jumps else 0

    def _ended(self, selection: Selection) -> bool:
        """Return whether another episode has begun since a selection."""
        return self._scene_ns() > selection.selected_ns and self._sensors.jumps == selection.jumps

    def _other_scene(self, selection: Selection) -> str:
        """Say in what way the camera shows another scene than that of a selection, '' if not."""
        if self._sensors.jumps != selection.jumps:
            return 'the clock of its pictures has jumped: another camera, simulator or recording'
        return rivals(self, self._own_topics, selection.publishers)

    def _other_camera(self, selection: Selection, size: tuple[int, int]) -> str:
        """Say how pictures of a size differ from those of a selection, '' if they do not."""
        if size != selection.size:
            return 'pictures have {1}x{0} pixels now, and had {3}x{2}'.format(
                *size, *selection.size)
        if selection.plane is not None:
            plane, _ = self._calibration(size)
            if plane is None or plane.apart(selection.plane) > MOVED:
                return f'{CAMERA_INFO.name} or {CAMERA_POSE.name} has changed'
        return ''

    def _forget(self, why: str) -> None:
        """Follow nothing any more."""
        self._selection = None
        if self._told_goal is not None:
            self._goal_objects.publish(encode_objects(
                (), np.empty((0, 2)), None, self._told_goal, '', ObjectStates.SOURCE_TRACKED))
            self._told_goal = None
        self.get_logger().warning(
            f'the selected objects are forgotten: {why}; select them again')

    def _why_not(self) -> str:
        """Say why nothing is followed, '' if something is."""
        return '' if self._selection is not None else (
            'no objects are selected; call select_objects')

    def _tell(self, selection: Selection, tracked: Tracked) -> None:
        """Log which objects are known less well than before, and which well again."""
        usual = (SEEN, HIDDEN)
        for name, before, now in zip(selection.names, selection.tracked.states, tracked.states):
            if now == before or {before, now} <= {*usual}:
                continue
            # On two lines: ROS refuses one that logs in two severities.
            if now in usual:
                self.get_logger().info(f'{escaped(name)} is {now}')
            else:
                self.get_logger().warning(f'{escaped(name)} is {now}')

    def _encode(self, found: Sequence[str], tracked: Tracked, plane: Plane | None,
                header: Any) -> ObjectStates:
        """Return the message about objects in a picture of this header; TapError for NaN."""
        if not np.isfinite(tracked.pixels).all():
            raise TrackingError(f'parameter tracker: {self.params["tracker"]} places '
                                f'{listing(found)} at pixels that are no numbers')
        poses = None
        if plane is not None:
            poses = np.full((len(found), 7), np.nan)
            poses[:, :2] = plane.of_middle(plane.shrink(tracked.pixels))
            poses[:, 2] = MIDDLE
            poses[(np.array(tracked.states) == LOST) | ~np.isfinite(poses[:, :3]).all(1)] = np.nan
        message = encode_objects(
            found, tracked.pixels, poses, header.stamp,
            header.frame_id if plane is None else WORLD_FRAME, ObjectStates.SOURCE_TRACKED)
        message.states, message.confidence = tracked.states, list(map(float, tracked.confidence))
        return message


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare('tracker', 'rigid', 'What follows the objects: their shapes on the table '
                       '(rigid), or a tracker of another package.',
                       choices=names('tap_ros.trackers'))
    parameters.declare_shared('image_transport', 'joint_prefix', robot_mask='all')
    parameters.declare_camera(f'{WORLD_FRAME}; with camera_z 0: as camera/pose tells')
    parameters.declare_arm()
    parameters.declare('max_silence', 0.35,
                       'Seconds; of a picture without joint states nearer to it than this the '
                       'gripper is not known.', low=0.05, high=60.0, read_only=False)
    parameters.declare('patience', 0.1, 'Seconds that the joints of a picture, or the robot mask '
                       'of a goal, are waited for.', low=0.0, high=60.0)
    return parameters
