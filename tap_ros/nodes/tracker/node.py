# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Follows objects that were clicked once in the camera's pictures: objects and goal/objects."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import threading
import time
from typing import Any

import numpy as np
from rclpy.node import Node
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import SelectObjects
from tap_ros.base.contract import HIDDEN, LOST, object_names, SEEN, WORLD_FRAME
from tap_ros.base.errors import TapError, TrackingError
from tap_ros.base.plugins import load_plugin
from tap_ros.base.text import escaped, listing
from tap_ros.messages.images import is_empty
from tap_ros.messages.objects import decode_objects, MAX_OBJECTS
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import CAMERA_INFO, CAMERA_POSE
from tap_ros.nodes.tracker.inputs import drawn_in, select, TrackerInputs
from tap_ros.nodes.tracker.outlines import OutlinePublisher, polygons
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.ros.calls import answering, log_error
from tap_ros.ros.observations import Moment
from tap_ros.ros.parameters import CameraParameters, Parameters, setting
from tap_ros.ros.subscriptions import Publishers, rivals
from tap_ros.ros.topics import encode_objects, LATCHED, SERVICE_QOS, STREAM
from tap_ros.tracking.plane import MIDDLE, Plane
from tap_ros.tracking.proposals import propose
from tap_ros.tracking.protocols import Tracked, Tracker, View

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
    publishers: Publishers  # of the pictures then
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
        self._lock = threading.RLock()  # of what follows
        self._selection: Selection | None = None
        self._found_ns: int | None = None  # stamp of the goal whose objects were published
        self._inputs = TrackerInputs(self, self.params, self._why_idle, self._on_episode)
        self._diagnostics = self._inputs.diagnostics
        self._sensors, self._goals = self._inputs.sensors, self._inputs.goals
        self._objects = self.create_publisher(ObjectStates, 'objects', STREAM)
        self._goal_objects = self.create_publisher(ObjectStates, 'goal/objects', LATCHED)
        self._outlines = OutlinePublisher(self)
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

    def _why_idle(self) -> str:
        return '' if self._selection is not None else (
            'no objects are selected; call select_objects')

    # Selecting

    def _on_episode(self) -> None:
        with self._lock:
            if self._selection is not None and self._ended(self._selection):
                self._forget('a new episode has begun', expected=True)

    def _on_select(self, request: SelectObjects.Request,
                   response: SelectObjects.Response) -> SelectObjects.Response:
        with self._lock:
            moment, view = self._inputs.clicked(to_nanoseconds(request.stamp))
            plane, camera = self._inputs.calibration(view.image.shape[:2])
            if request.propose:
                tracked = self._propose(view, camera)
                found = list(object_names(len(tracked.pixels)))
                response.message = f'{len(found)} things differ in the goal picture'
            else:
                found, tracked, response.message = self._select(
                    request, moment, view, plane, camera)
            response.objects = self._encode(
                found, tracked, plane, moment.messages['image'].header).objects
        response.outlines, response.success = polygons(tracked), True
        return response

    def _select(self, request: SelectObjects.Request, moment: Moment, view: View,
                plane: Plane | None,
                camera: PinholeCamera | None) -> tuple[tuple[str, ...], Tracked, str]:
        """
        Follow other objects from a picture on.

        :return: names of those that are not refused, where they are, and what is to be said.
        :raises TapError: for names or clicks that cannot be used, and where all are refused; then
            nothing changes.
        """
        if not 1 <= len(request.names) == len(request.u) == len(request.v) <= MAX_OBJECTS:
            raise TrackingError(
                f'names, u and v have {len(request.names)}, {len(request.u)} and '
                f'{len(request.v)} entries; expected as many of each, 1 to {MAX_OBJECTS}')
        drawn = drawn_in(request)
        found, clicks = decode_objects(encode_objects(
            request.names, np.column_stack([request.u, request.v]), None, 0, '',
            ObjectStates.SOURCE_TRACKED), 'select_objects', view.image.shape[:2])
        if cameras := rivals(self._inputs.publishers()):
            raise TrackingError(f'{cameras}; leave one of them')
        others = self.count_publishers('objects') - 1
        if others > 0:
            raise TrackingError(
                f'{others} other nodes publish on {self.resolve_topic_name("objects")}; end '
                'them, or start the simulator with objects:=tracked')
        tracker: Tracker = self._make(camera)
        kept, why, tracked = select(tracker, view, clicks, drawn)
        refused = [f'{escaped(name)}: {why[k]}' for k, name in enumerate(found) if k in why]
        found = tuple(found[k] for k in kept)
        said = '; '.join([f'following {listing(found)}', *refused])
        message = self._encode(found, tracked, plane, moment.messages['image'].header)
        self._selection = Selection(
            found, tracker, plane, view.image.shape[:2], moment.stamp_ns, self._sensors.jumps,
            self._inputs.publishers(), moment.stamp_ns, moment.received,
            tracked, message)
        self._objects.publish(message)
        self._sensors.wake()  # for the goal
        self.get_logger().info(said)
        return found, tracked, said

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
        for pixel in propose(view, self._inputs.goal_view(goal, view.image.shape[:2]), camera):
            with suppress(TrackingError):  # it could not be followed
                tracker.select(view, [pixel])
                found.append(pixel)
        if not found:
            raise TrackingError('the goal picture shows nothing elsewhere; click on each object')
        return tracker.select(view, found)  # for the outlines

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
        if changed := rivals(self._inputs.publishers(), selection.publishers) or (
                '' if self._sensors.jumps == selection.jumps else 'the clock of its pictures has '
                'jumped: another camera, simulator or recording'):
            self._forget(changed)
            return
        moment = self._inputs.newest()
        if moment is None or moment.stamp_ns < selection.stamp_ns:
            return
        if moment.stamp_ns == selection.stamp_ns:
            if moment.received > selection.received and selection.message is not None:
                self._objects.publish(selection.message)  # it was sent again
                self._selection = replace(selection, received=moment.received)
            return
        if self._inputs.lacks_joints(moment):
            return
        # Whatever fails costs this picture, which is not tried again.
        self._selection = replace(
            selection, stamp_ns=moment.stamp_ns, received=moment.received, message=None)
        view = self._inputs.view(moment)
        if changed := self._other_camera(selection, view.image.shape[:2]):
            self._forget(changed)
            return
        begin = time.perf_counter()
        tracked = selection.tracker.update(view)
        self._diagnostics.took(1e3 * (time.perf_counter() - begin), 'track')
        header = moment.messages['image'].header
        message = self._encode(selection.names, tracked, selection.plane, header)
        self._outlines.send(selection.names, tracked, header)
        self._objects.publish(message)
        self._log_states(selection, tracked)
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
            found = selection.tracker.find(self._inputs.goal_view(goal, selection.size))
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
        self._found_ns = goal.stamp_ns
        if lost.any():
            missing = listing([selection.names[k] for k in np.flatnonzero(lost)])
            self.get_logger().warning(f'goal/image: {missing} not found: place it, in the '
                                      'explorer or by goal_objects of reach_goal')

    def _ended(self, selection: Selection) -> bool:
        """Return whether another episode has begun since a selection."""
        return (self._inputs.scene_ns() > selection.selected_ns
                and self._sensors.jumps == selection.jumps)

    def _other_camera(self, selection: Selection, size: tuple[int, int]) -> str:
        """Say how pictures of a size differ from those of a selection, '' if they do not."""
        if size != selection.size:
            return 'pictures have {1}x{0} pixels now, and had {3}x{2}'.format(
                *size, *selection.size)
        if selection.plane is not None:
            plane, _ = self._inputs.calibration(size)
            if plane is None or plane.apart(selection.plane) > MOVED:
                return f'{CAMERA_INFO.name} or {CAMERA_POSE.name} has changed'
        return ''

    def _forget(self, why: str, expected: bool = False) -> None:
        """Follow nothing any more."""
        self._selection = None
        if self._found_ns is not None:
            self._goal_objects.publish(encode_objects(
                (), np.empty((0, 2)), None, self._found_ns, '', ObjectStates.SOURCE_TRACKED))
            self._found_ns = None
        said = f'the selected objects are forgotten: {why}; select them again'
        # On two lines: ROS refuses one that logs in two severities.
        if expected:
            self.get_logger().info(said)
        else:
            self.get_logger().warning(said)

    def _log_states(self, selection: Selection, tracked: Tracked) -> None:
        """Log which objects are known less well than before, and which well again."""
        usual = (SEEN, HIDDEN)
        for name, before, now in zip(selection.names, selection.tracked.states, tracked.states):
            if now == before or {before, now} <= {*usual}:
                continue
            if now in usual:  # on two lines, see _forget
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
            poses[:, :2] = plane.places(plane.shrink(tracked.pixels), MIDDLE)[:, :2]
            poses[:, 2] = MIDDLE
            poses[(np.array(tracked.states) == LOST) | ~np.isfinite(poses[:, :3]).all(1)] = np.nan
        message = encode_objects(
            found, tracked.pixels, poses, header.stamp,
            header.frame_id if plane is None else WORLD_FRAME, ObjectStates.SOURCE_TRACKED)
        message.states, message.confidence = tracked.states, list(map(float, tracked.confidence))
        return message


@dataclass(frozen=True)
class TrackerParameters:
    """
    Parameters that this node alone has.

    :param tracker: What follows the objects: their shapes on the table (rigid), or a tracker of
        another package.
    :param max_silence: Seconds; of a picture without joint states nearer to it than this the
        gripper is not known.
    :param patience: Seconds that the joints of a picture, or the robot mask of a goal, are waited
        for.
    """

    tracker: str = setting('rigid', plugins='tap_ros.trackers')
    max_silence: float = setting(0.35, between=(0.05, 60.0), read_only=False)
    patience: float = setting(0.1, between=(0.0, 60.0))


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_fields(TrackerParameters)
    parameters.declare_shared('image_transport', 'joint_prefix', robot_mask='all')
    parameters.declare_fields(CameraParameters)
    parameters.declare_arm()
    return parameters
