# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A page for browsers: see camera, goal, subgoal and plan, and try them."""

from collections import deque, OrderedDict
from collections.abc import Mapping
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
from tap_ros.messages.subgoals import decode_subgoal, decode_subgoals
from tap_ros.nodes.clients import CallError
from tap_ros.nodes.diagnostics import Diagnostics
from tap_ros.nodes.explorer.board import Board
from tap_ros.nodes.explorer.calls import ExplorerCalls
from tap_ros.nodes.explorer.distances import Distances
from tap_ros.nodes.explorer.server import ExplorerServer
from tap_ros.nodes.observations import reception_time
from tap_ros.nodes.parameters import declare_transport, Parameters
from tap_ros.nodes.run import run_node
from tap_ros.nodes.subscriptions import ADAPT_PERIOD, AdaptiveSubscription
from tap_ros.nodes.topics import camera_image, LATCHED, STREAM
from tap_ros.plugins import names
from tap_ros.text import escaped

PERIOD_S = 0.1  # between two looks at what is to be shown
SILENT_S = 2.0  # after which the page says that a topic is silent
LARGEST = 640  # px; larger pictures are made smaller for the page
LOSSLESS = 256  # px; larger ones are sent as JPEG
STALE = 3  # of diagnostic_msgs/DiagnosticStatus
LOG_LINES = 50
RECENT = 10  # pictures and lists of objects that are kept; a picture of 1080p has 6 MB
FORGOTTEN_S = 60.0  # after which a node that is silent is shown no more
KEPT = ('camera', 'objects', 'goal', 'goal_objects')  # whose age /diagnostics tells
COLUMNS, MAX_SHOWN = 4, 12  # subgoals of one answer in the page


class ExplorerNode(Node):
    """
    Shows what the other nodes publish, and passes on what browsers ask for.

    Pictures are encoded only while a browser is connected, the newest of each kind. A goal that
    was begun goes on when browsers leave; it is cancelled when this node ends.
    """

    def __init__(self) -> None:
        super().__init__('explorer_node')
        self.params = declare_parameters(self)
        self._lock = threading.Lock()
        self._newest: dict[str, tuple[Any, float]] = {}  # kind -> message, when it came
        # The last pictures and objects by their stamps, for a photograph.
        self._recent: dict[str, OrderedDict[int, tuple[Any, float]]] = {
            'camera': OrderedDict(), 'objects': OrderedDict()}
        self._changed: set[str] = set()  # kinds of pictures that are to be encoded
        self._sizes: dict[str, tuple[int, int]] = {}  # (width, height) before it is made smaller
        self._distances = Distances()
        self._diagnostics: dict[str, tuple[int, str, float]] = {}  # level, text, when it came
        self._log: deque[str] = deque(maxlen=LOG_LINES)
        self._log_count = 0
        self._task, self._note = '', ''
        self._problem: dict[str, Any] = {'count': 0, 'text': ''}
        self._sheet_stamp: Any = None  # of the picture whose subgoals are shown side by side
        self._goal_publishers: Any = None
        self._board = Board()
        self._calls = ExplorerCalls(
            self, self._tell, self._complain, self._on_answer, self._photograph)
        kind, topic = camera_image(self.params)
        self._service = Diagnostics(self, {topic: SILENT_S, 'objects': SILENT_S,
                                           'goal/image': math.inf, 'goal/objects': math.inf})
        self._heard = [
            self._hear(kind, topic, 'camera', STREAM),
            self._hear(Image, 'goal/image', 'goal', LATCHED),
            self._hear(Subgoal, 'subgoal', 'subgoal', LATCHED),
            self._hear(ObjectStates, 'objects', 'objects', STREAM),
            self._hear(ObjectStates, 'goal/objects', 'goal_objects', LATCHED),
            AdaptiveSubscription(self, Episode, 'episode', self._on_episode, STREAM),
            AdaptiveSubscription(
                self, DiagnosticArray, '/diagnostics', self._on_diagnostics, STREAM)]
        self._plan: AdaptiveSubscription | None = None  # drawn only while somebody listens
        self._server = ExplorerServer(
            self._board, self._calls.do, self.params['host'], self.params['port'],
            self.params['token'])
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD_S, self._show, clock=clock)
        self.create_timer(ADAPT_PERIOD, self._look_after, clock=clock)
        self.get_logger().info(f'ready: open {self._server.url}')

    def close(self) -> None:
        """End the goal that a browser began, and say goodbye to browsers."""
        self._calls.close()
        self._server.close()

    # What comes

    def _hear(self, kind: type, topic: str, name: str, qos: Any) -> AdaptiveSubscription:
        """Keep the newest message of a topic."""
        def keep(message: Any, info: Mapping[str, Any]) -> None:
            with self._lock:
                self._newest[name] = message, reception_time(info)
                self._changed.add(name)
                if name in self._recent:
                    recent = self._recent[name]
                    recent[to_nanoseconds(message.header.stamp)] = self._newest[name]
                    if len(recent) > RECENT:
                        recent.popitem(last=False)
            if name in KEPT:
                self._service.received(topic)
        return AdaptiveSubscription(self, kind, topic, keep, qos)

    def _look_after(self) -> None:
        for heard in self._heard:
            heard.adapt()
        if self._board.watched and self._plan is None:
            self._plan = self._hear(Image, 'plan/overlay', 'plan', STREAM)
        elif not self._board.watched and self._plan is not None:
            self.destroy_subscription(self._plan.subscription)
            self._plan = None

    def _on_episode(self, message: Episode) -> None:
        if message.event == Episode.START:
            self._task = escaped(message.task, 40)
            self._distances.clear()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for name in [name for name, (*_, came) in self._diagnostics.items()
                     if now - came > FORGOTTEN_S]:
            del self._diagnostics[name]
        for status in message.status:
            name = escaped(status.name, 100)
            if name in self._diagnostics or len(self._diagnostics) < 200:
                self._diagnostics[name] = status.level[0], escaped(status.message, 200), now

    def _on_answer(self, response: PredictSubgoal.Response) -> None:
        """Show all subgoals of an answer side by side; runs in a thread of the calls."""
        first = response.subgoals[0]
        names = tuple(first.object_names)
        subgoals = decode_subgoals(
            response, names, (first.image.height, first.image.width))[:MAX_SHOWN]
        self._sheet_stamp = None
        if len(subgoals) > 1:
            panels = [overlay(one.image, one.object_maps) for one in subgoals]
            panels += [np.full_like(panels[0], 255)] * (-len(panels) % min(COLUMNS, len(panels)))
            width = min(COLUMNS, len(panels))
            sheet = grid([panels[i:i + width] for i in range(0, len(panels), width)])
            self._sheet_stamp = first.header.stamp
            self._board.put('subgoal', png_bytes(sheet))
        self._note = (f'{len(response.subgoals)} subgoals'
                      if len(response.subgoals) > 1 else '')

    def _photograph(self) -> None:
        """
        Publish the camera's newest picture as the goal, with the objects in it.

        :raises CallError: when there is none, or none with objects where there are some.
        """
        if self._calls.offered('reset'):
            raise CallError('photograph: the simulator takes its goal pictures itself')
        with self._lock:
            pictures, objects = (dict(self._recent[name]) for name in ('camera', 'objects'))
            told = {'objects', 'goal_objects'} & set(self._newest)
        fresh = [stamp for stamp, (_, came) in pictures.items()
                 if time.monotonic() - came < SILENT_S]
        if not fresh:
            raise CallError('photograph: the camera is silent; no picture to take')
        # Objects of another moment would be taken for the goal.
        both = [stamp for stamp in fresh if stamp in objects]
        if told and not both:
            raise CallError("photograph: no objects have the stamp of one of the camera's newest "
                            'pictures; publish them with it')
        stamp = (both or fresh)[-1]
        picture = pictures[stamp][0]
        if not isinstance(picture, Image):
            raise CallError('photograph: a goal picture is sensor_msgs/Image; start with '
                            'image_transport:=raw')
        if self._goal_publishers is None:
            self._goal_publishers = (
                self.create_publisher(ObjectStates, 'goal/objects', LATCHED),
                self.create_publisher(Image, 'goal/image', LATCHED))
        to_objects, to_image = self._goal_publishers
        if both:
            to_objects.publish(objects[stamp][0])
        to_image.publish(picture)

    # What is shown

    def _tell(self, text: str) -> None:
        """Write a line that all browsers show."""
        with self._lock:
            self._log.append(text)
            self._log_count += 1

    def _complain(self, text: str) -> None:
        """Say to all browsers what could not be done."""
        self._tell(text)
        self._service.error(text)
        with self._lock:
            self._problem = {'count': self._problem['count'] + 1, 'text': text}

    def _show(self) -> None:
        """Bring the board up to date."""
        # Before the log: how a run ended is told first, so that who sees no run sees how it ended.
        running = self._calls.running
        with self._lock:
            newest = dict(self._newest)
            changed = self._changed if self._board.watched else self._changed - {
                'camera', 'goal', 'subgoal', 'plan'}
            self._changed = self._changed - changed
            log, log_count, problem = list(self._log), self._log_count, self._problem
        objects, goals = (self._decode(newest, name) for name in ('objects', 'goal_objects'))
        if 'goal_objects' in changed:
            self._distances.clear()
        if 'objects' in changed and objects and goals:
            stamp = to_nanoseconds(newest['objects'][0].header.stamp)
            self._distances.add(stamp / 1e9, objects, goals)
        if not self._board.watched:
            return
        for kind in ('camera', 'goal', 'subgoal', 'plan'):
            # The first subgoal of an answer comes by topic, too.
            if kind in changed and not (
                    kind == 'subgoal' and newest[kind][0].header.stamp == self._sheet_stamp):
                try:
                    self._show_picture(kind, _picture_of(newest[kind][0], kind))
                except TapError as error:
                    self.get_logger().warning(escaped(error, 300), throttle_duration_sec=10.0)
        now = time.monotonic()
        ages = {kind: now - came for kind, (_, came) in newest.items()}
        self._board.put('state', json.dumps({
            'kind': 'state', 'task': self._task, 'tasks': names('tap_ros.tasks'),
            'simulator': self._calls.offered('reset'),
            'movable': self._calls.offered('set_goal') and bool(goals) and not running,
            'camera': {**self._size('camera'), 'objects': _listed(objects),
                       'targets': _listed({n: goals[n] for n in objects if n in goals}),
                       'note': _silence(ages.get('camera'))},
            'goal': {**self._size('goal'), 'objects': _listed(goals),
                     'note': '' if 'goal' in ages else 'none yet',
                     'hint': 'The goal of the planner.'},
            'subgoal_note': self._note, 'problem': problem,
            'run': {'running': running, 'stage': self._calls.stage if running else '',
                    'text': self._calls.stage or 'starting' if running else 'idle'},
            'diagnostics': [
                {'name': name, 'level': STALE if now - came > SILENT_S + 1 else level,
                 'message': 'silent' if now - came > SILENT_S + 1 else text}
                for name, (level, text, came) in sorted(self._diagnostics.items())],
            'log': log, 'log_count': log_count}))
        self._board.put('history', json.dumps({'kind': 'history', **self._distances.shown()}))

    def _decode(self, newest: Mapping[str, tuple[Any, float]],
                name: str) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
        """Return objects by name: ((x, y, z), (u, v)); empty where they cannot be used."""
        if name not in newest:
            return {}
        message = newest[name][0]
        try:
            names, pixels = decode_objects(message, name)
        except TapError as error:
            self.get_logger().warning(escaped(error, 300), throttle_duration_sec=10.0)
            return {}
        places = [one.pose.position for one in message.objects]
        return {each: ((place.x, place.y, place.z), tuple(pixel.tolist()))
                for each, place, pixel in zip(names, places, pixels)}

    def _show_picture(self, kind: str, image: np.ndarray) -> None:
        height, width = image.shape[:2]
        self._sizes[kind] = width, height
        share = LARGEST / max(width, height)
        if share < 1:
            size = [max(1, round(share * side)) for side in (width, height)]
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if kind == 'subgoal':
            self._note = ''
        if max(width, height) <= LOSSLESS or kind == 'plan':
            self._board.put(kind, png_bytes(image))
        else:
            self._board.put(kind, cv2.imencode('.jpg', image[..., ::-1])[1].tobytes())

    def _size(self, kind: str) -> dict[str, int]:
        width, height = self._sizes.get(kind, (0, 0))
        return {'width': width, 'height': height}


def _listed(objects: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]
            ) -> list[dict[str, Any]]:
    return [{'name': name, 'u': round(u, 2), 'v': round(v, 2)}
            for name, (_, (u, v)) in objects.items()]


def _picture_of(message: Any, kind: str) -> np.ndarray:
    """Return what is shown of a message: uint8 (H, W, 3); of a Subgoal with its maps."""
    if not isinstance(message, Subgoal):
        return decode_image(message, kind)
    one = decode_subgoal(
        message, message.object_names, (message.image.height, message.image.width))
    return overlay(one.image, one.object_maps)


def _silence(age: float | None) -> str:
    """Say since when a topic is silent, in steps that do not change with every look."""
    if age is None:
        return 'nothing has come yet'
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
    declare_transport(parameters)
    return parameters


def main(args: list[str] | None = None) -> int:
    """Run the node; the answer is the exit code of the process."""
    return run_node(ExplorerNode, 'explorer_node', args)


if __name__ == '__main__':
    sys.exit(main())
