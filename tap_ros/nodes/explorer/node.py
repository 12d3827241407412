# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A page for browsers: see camera, goal, subgoal and plan, and try them."""

from collections import deque
from collections.abc import Mapping
from functools import cache
import json
import math
import sys
import threading
import time
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import Episode, ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import TapError
from tap_ros.images.drawing import grid, overlay, png_bytes
from tap_ros.messages.images import decode_image
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.nodes.calls import CallError
from tap_ros.nodes.client import positions_of, subgoals_of
from tap_ros.nodes.diagnostics import Diagnostics
from tap_ros.nodes.explorer.calls import ExplorerCalls
from tap_ros.nodes.explorer.server import ExplorerServer
from tap_ros.nodes.observations import Observations, reception_time
from tap_ros.nodes.parameters import declare_transport, Parameters
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subscriptions import ADAPT_PERIOD, AdaptiveSubscription
from tap_ros.nodes.topics import camera_image, LATCHED, STREAM
from tap_ros.plugins import load_plugin, names
from tap_ros.text import escaped

PERIOD_S = 0.1  # between two looks at what is to be shown
SILENT_S = 2.0  # after which the page says that a topic is silent
LARGEST = 640  # px; larger pictures are made smaller for the page
LOSSLESS = 256  # px; larger ones are sent as JPEG
STALE = 3  # of diagnostic_msgs/DiagnosticStatus
LOG_LINES = 50
FORGOTTEN_S = 60.0  # after which a node that is silent is shown no more
PICTURES = ('camera', 'goal', 'subgoal', 'plan')
COLUMNS, MAX_SHOWN = 4, 12  # subgoals of one answer in the page
POINTS = 1000  # of distances: of so many pictures, four minutes in real time

Place = tuple[float, ...]  # x, y, z in m, u, v in pixels


class ExplorerNode(Node):
    """
    Shows what the other nodes publish, and passes on what browsers ask for.

    Pictures are encoded only while a browser is connected, the newest of each kind. A goal that
    was begun goes on when browsers leave; it is cancelled when this node ends.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('explorer_node', **options)
        self.params = declare_parameters(self)
        self._lock = threading.Lock()
        self._newest: dict[str, tuple[Any, float]] = {}  # kind -> message, when it came
        self._moments = Observations('camera', 'objects')  # the last ones, for a photograph
        self._changed: set[str] = set()  # kinds whose newest message was not shown yet
        self._sizes: dict[str, tuple[int, int]] = {}  # (width, height) before it is made smaller
        self._distances = Distances()
        self._diagnostics: dict[str, tuple[int, str, float]] = {}  # level, text, when it came
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._log_count = 0
        self._task, self._note = self.params['task'], ''
        self._problem: dict[str, Any] = {'count': 0, 'text': ''}
        self._sheet_stamp: Any = None  # of the picture whose subgoals are shown side by side
        self._scene_ns = 0  # subgoals and plans of pictures before that are of an old scene
        self._goal_publishers: Any = None
        self._calls = ExplorerCalls(
            self, self._tell, self._complain, self._on_answer, self._photograph)
        self._server = ExplorerServer(
            self._calls.do, self.params['host'], self.params['port'], self.params['token'])
        kind, topic = camera_image(self.params)
        self._service = Diagnostics(self, {topic: SILENT_S, 'objects': SILENT_S,
                                           'goal/image': math.inf, 'goal/objects': math.inf})
        self._heard = [
            self._hear(kind, topic, 'camera', STREAM),
            self._hear(Image, 'goal/image', 'goal', LATCHED),
            self._hear(Subgoal, 'subgoal', 'subgoal', LATCHED, counted=False),
            self._hear(ObjectStates, 'objects', 'objects', STREAM),
            self._hear(ObjectStates, 'goal/objects', 'goal_objects', LATCHED),
            AdaptiveSubscription(self, Episode, 'episode', self._on_episode, STREAM),
            AdaptiveSubscription(
                self, DiagnosticArray, '/diagnostics', self._on_diagnostics, STREAM)]
        self._plan: AdaptiveSubscription | None = None  # drawn only while somebody listens
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD_S, self._show, clock=clock)
        self.create_timer(ADAPT_PERIOD, self._look_after, clock=clock)
        self.get_logger().info(f'ready: open {self.url}')

    @property
    def url(self) -> str:
        """Where the page is."""
        return self._server.url

    def close(self) -> None:
        """End the goal that a browser began, and say goodbye to browsers."""
        self._calls.close()
        self._server.close()

    # What comes

    def _hear(self, kind: type, topic: str, name: str, qos: Any,
              counted: bool = True) -> AdaptiveSubscription:
        """Keep the newest message of a topic."""
        def keep(message: Any, info: Mapping[str, Any]) -> None:
            if counted:
                self._service.received(topic)
            with self._lock:
                before, _ = self._newest.get(name, (None, 0.0))
                if name == 'goal' and before not in (None, message):
                    self._forget_plans()
                if name in ('subgoal', 'plan') and self._is_old(message):
                    return
                self._newest[name] = message, reception_time(info)
                self._changed.add(name)
            if name in ('camera', 'objects'):
                self._moments.put(name, message, reception_time(info))
        return AdaptiveSubscription(self, kind, topic, keep, qos)

    def _forget_plans(self) -> None:
        """Show no more what was predicted and planned for another goal."""
        for kind in ('subgoal', 'plan'):
            self._newest.pop(kind, None)
            self._changed.discard(kind)
            self._server.put(kind, b'')
        self._note = ''

    def _is_old(self, message: Any) -> bool:
        """Tell whether what was made of a picture belongs to an old scene; stamp 0: of a file."""
        return 0 < to_nanoseconds(message.header.stamp) < self._scene_ns

    def _look_after(self) -> None:
        for heard in self._heard:
            heard.adapt()
        if self._server.browsers and self._plan is None:
            self._plan = self._hear(Image, 'plan/overlay', 'plan', STREAM, counted=False)
        elif not self._server.browsers and self._plan is not None:
            self.destroy_subscription(self._plan.subscription)
            self._plan = None

    def _on_episode(self, message: Episode) -> None:
        if message.event == Episode.START:
            self._task = escaped(message.task, 40)
            self._distances.clear()
            with self._lock:
                if self._calls.offered('reset'):  # stamps are the simulator's
                    self._scene_ns = to_nanoseconds(message.header.stamp)
                self._forget_plans()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        self._diagnostics = {name: found for name, found in self._diagnostics.items()
                             if now - found[-1] < FORGOTTEN_S}
        for status in message.status:
            name = escaped(status.name, 100)
            if name in self._diagnostics or len(self._diagnostics) < 200:
                self._diagnostics[name] = status.level[0], escaped(status.message, 200), now

    def _on_answer(self, response: PredictSubgoal.Response) -> None:
        """Show all subgoals of an answer side by side; runs in a thread of the calls."""
        if self._is_old(response.subgoals[0]):
            return
        subgoals = subgoals_of(response)
        self._sheet_stamp = None
        if len(subgoals) > 1:
            panels = [overlay(one.image, one.object_maps) for one in subgoals[:MAX_SHOWN]]
            width = min(COLUMNS, len(panels))
            panels += [np.full_like(panels[0], 255)] * (-len(panels) % width)
            sheet = grid([panels[i:i + width] for i in range(0, len(panels), width)])
            self._sheet_stamp = response.subgoals[0].header.stamp
            self._server.put('subgoal', png_bytes(sheet))
        self._note = f'{len(subgoals)} subgoals' if len(subgoals) > 1 else ''

    def _photograph(self) -> None:
        """
        Publish the camera's newest picture as the goal, with the objects in it.

        :raises CallError: when there is none, or none with objects where there are some.
        """
        if self._calls.offered('reset'):
            raise CallError('photograph: the simulator takes its goal pictures itself')
        since = time.monotonic() - SILENT_S
        told = {'objects', 'goal_objects'} & set(self._newest)
        # Objects of another moment would be taken for the goal.
        found = self._moments.newest('camera', *['objects'] if told else [], since=since)
        if found is None:
            raise CallError("photograph: no objects have the stamp of one of the camera's newest "
                            'pictures; publish them with it' if self._moments.newest(
                                'camera', since=since) else
                            'photograph: the camera is silent; no picture to take')
        if not isinstance(found['camera'], Image):
            raise CallError('photograph: a goal picture is sensor_msgs/Image; start with '
                            'image_transport:=raw')
        if self._goal_publishers is None:
            self._goal_publishers = (
                self.create_publisher(ObjectStates, 'goal/objects', LATCHED),
                self.create_publisher(Image, 'goal/image', LATCHED))
        to_objects, to_image = self._goal_publishers
        if told:
            to_objects.publish(found['objects'])
        to_image.publish(found['camera'])

    # What is shown

    def _tell(self, text: str) -> None:
        """Write a line that all browsers show."""
        with self._lock:
            self._log.append(text)
            self._log_count += 1

    def _complain(self, text: str, ours: bool) -> None:
        """Say to all browsers what could not be done, and to /diagnostics what we did wrong."""
        self._tell(text)
        if ours:
            self._service.error(text)
        with self._lock:
            self._problem = {'count': self._problem['count'] + 1, 'text': text}

    def _show(self) -> None:
        """Bring what browsers see up to date."""
        # Before the log: how a run ended is told first, so that who sees no run sees how it ended.
        running, watched = self._calls.running, self._server.browsers
        with self._lock:
            newest = dict(self._newest)
            changed = self._changed if watched else self._changed - {*PICTURES}
            self._changed = self._changed - changed
            log, log_count, problem = list(self._log), self._log_count, self._problem
        objects, goals = (self._decode(newest, name) for name in ('objects', 'goal_objects'))
        if 'goal_objects' in changed:
            self._distances.clear()
        if 'objects' in changed and objects and goals:
            stamp = to_nanoseconds(newest['objects'][0].header.stamp)
            self._distances.add(stamp / 1e9, objects, goals)
        if not watched:
            return
        for kind in PICTURES:
            # The first subgoal of an answer comes by topic, too.
            if kind in changed and not (
                    kind == 'subgoal' and newest[kind][0].header.stamp == self._sheet_stamp):
                try:
                    self._show_picture(kind, _picture_of(newest[kind][0], kind))
                except TapError as error:
                    self.get_logger().warning(escaped(error, 300), throttle_duration_sec=10.0)
        now, simulator = time.monotonic(), self._calls.offered('reset')
        self._server.put('state', json.dumps({
            'kind': 'state', 'task': self._task, 'tasks': names('tap_ros.tasks'),
            'simulator': simulator,
            'plans': not simulator or not _grips(self._task),
            'movable': self._calls.offered('set_goal') and bool(goals) and not running,
            'camera': {**self._size('camera'), 'objects': _listed(objects),
                       'targets': _listed({n: goals[n] for n in objects if n in goals}),
                       'note': _silence(now, newest.get('camera'))},
            'goal': {**self._size('goal'), 'objects': _listed(goals),
                     'note': '' if 'goal' in newest else 'none yet'},
            'subgoal_note': self._note, 'problem': problem,
            'run': {'running': running, 'stage': self._calls.stage if running else '',
                    'text': self._calls.stage or 'starting' if running else 'idle'},
            'diagnostics': [
                {'name': name, 'level': STALE if now - came > SILENT_S + 1 else level,
                 'message': 'silent' if now - came > SILENT_S + 1 else text}
                for name, (level, text, came) in sorted(self._diagnostics.items())],
            'log': log, 'log_count': log_count}))
        self._server.put('history', json.dumps({'kind': 'history', **self._distances.shown()}))

    def _decode(self, newest: Mapping[str, tuple[Any, float]], name: str) -> dict[str, Place]:
        """Return the places of objects by name; empty where they cannot be used."""
        if name not in newest:
            return {}
        message = newest[name][0]
        try:
            found, pixels = decode_objects(message, name)
        except TapError as error:
            self.get_logger().warning(escaped(error, 300), throttle_duration_sec=10.0)
            return {}
        return {each: (*position, *pixel) for each, position, pixel in zip(
            found, positions_of(message).tolist(), pixels.tolist())}

    def _show_picture(self, kind: str, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        self._sizes[kind] = width, height
        share = LARGEST / max(width, height)
        if share < 1:
            size = [max(1, round(share * side)) for side in (width, height)]
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if kind == 'subgoal':
            self._note = ''
        lossless = max(width, height) <= LOSSLESS or kind == 'plan'
        self._server.put(kind, png_bytes(image) if lossless else cv2.imencode(
            '.jpg', image[..., ::-1])[1].tobytes())

    def _size(self, kind: str) -> dict[str, int]:
        width, height = self._sizes.get(kind, (0, 0))
        return {'width': width, 'height': height}


class Distances:
    """Distances from objects to their goals over time; a new goal or scene begins anew."""

    def __init__(self) -> None:
        self._of: tuple[tuple[str, ...], str] = (), ''  # names, unit
        self._points: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=POINTS)

    def clear(self) -> None:
        """Forget what was."""
        self._points.clear()

    def add(self, time: float, objects: Mapping[str, Place], goals: Mapping[str, Place]) -> None:
        """
        Note where objects are; in centimetres where all their poses are known, else in pixels.

        :param time: s; one that is before the newest begins anew.
        :param objects: places by name; NaN where unknown.
        :param goals: likewise; objects without one are left out.
        """
        names = tuple(name for name in objects if name in goals)
        metres = all(math.isfinite(x) for name in names for side in (objects, goals)
                     for x in side[name][:3])
        unit, part, factor = ('cm', slice(3), 100.0) if metres else ('px', slice(3, 5), 1.0)
        if (names, unit) != self._of or (self._points and time < self._points[-1][0]):
            self.clear()
        self._of = names, unit
        values = tuple(factor * math.dist(objects[name][part], goals[name][part])
                       for name in names)
        if not names or not all(map(math.isfinite, values)):
            return
        if self._points and self._points[-1][0] == time:
            self._points.pop()
        self._points.append((time, values))

    def shown(self) -> dict[str, Any]:
        """Return unit, names, times (s) and values (a list for each name)."""
        names, unit = self._of
        return {'unit': unit if self._points else '', 'names': list(names),
                'times': [round(time, 2) for time, _ in self._points],
                'values': [[round(values[k], 2) for _, values in self._points]
                           for k in range(len(names))]}


@cache
def _grips(task: str) -> bool:
    """Tell whether a task needs a gripper, which nothing plans; False for an unknown one."""
    try:
        return bool(getattr(load_plugin('tap_ros.tasks', task), 'gripping', False))
    except TapError:
        return False


def _listed(objects: Mapping[str, Place]) -> list[dict[str, Any]]:
    return [{'name': name, 'u': round(u, 2), 'v': round(v, 2)}
            for name, (*_, u, v) in objects.items()]


def _picture_of(message: Any, kind: str) -> np.ndarray:
    """Return what is shown of a message: uint8 (H, W, 3); of a Subgoal with its maps."""
    if not isinstance(message, Subgoal):
        return decode_image(message, kind)
    one = decode_subgoal(
        message, message.object_names, (message.image.height, message.image.width))
    return overlay(one.image, one.object_maps)


def _silence(now: float, newest: tuple[Any, float] | None) -> str:
    """Say since when a topic is silent, in steps that do not change with every look."""
    if newest is None:
        return 'nothing has come yet'
    age = now - newest[1]
    return f'silent for {age:.0f} s' if age > SILENT_S else ''


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare(
        'host', '127.0.0.1', 'Address at which browsers find the page. One that is not of this '
        'machine alone, such as 0.0.0.0, needs a token.')
    parameters.declare('port', 8000, 'Port of the page; 0: any that is free.', low=0, high=65535)
    parameters.declare(
        'token', '', 'That browsers must give as ?token=...; empty: none is needed where host is '
        'of this machine alone, else one is made up and printed.')
    parameters.declare('task', '', "Of the simulator's first scene; resets are heard.")
    declare_transport(parameters)
    return parameters


def main(args: list[str] | None = None) -> int:
    """Run the node; the answer is the exit code of the process."""
    return run_node(ExplorerNode, 'explorer_node', args)


if __name__ == '__main__':
    sys.exit(main())
