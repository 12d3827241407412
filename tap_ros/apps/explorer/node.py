# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A page for browsers: see camera, goal, subgoal and plan, and try them."""

from collections.abc import Mapping
from dataclasses import dataclass
import json
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import Image
from tap_msgs.msg import Episode, ObjectStates, Subgoal
from tap_ros.apps.explorer import display
from tap_ros.apps.explorer.browser_commands import ExplorerCalls
from tap_ros.apps.explorer.server import ExplorerServer
from tap_ros.apps.explorer.words import NodeStates
from tap_ros.base.plugins import names
from tap_ros.base.text import escaped
from tap_ros.images.drawing import picture_bytes
from tap_ros.messages.images import is_empty
from tap_ros.messages.objects import MAX_OBJECTS
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.ros.diagnostics import Diagnostics
from tap_ros.ros.observations import reception_time
from tap_ros.ros.parameters import Parameters, setting
from tap_ros.ros.subscriptions import (
    adapt_regularly,
    AdaptiveSubscription,
    publishers_of,
    steady_timer,
)
from tap_ros.ros.topics import camera_image, LATCHED, STREAM
from visualization_msgs.msg import ImageMarker

PERIOD_S = 0.1  # between two looks at what is to be shown
OBSERVER = 'observer/image_raw'
MOST_POINTS = 1000  # of an outline
OF_A_SCENE = ('objects', 'goal_objects', 'subgoal', 'plan')
PICTURES = ('camera', 'goal', 'subgoal', 'plan', 'observer')


class ExplorerNode(Node):
    """
    Shows what the other nodes publish, and passes on what browsers ask for.

    Pictures are encoded only while a browser is connected, the newest of each kind. A goal that
    was begun goes on when browsers leave; it is cancelled when this node ends.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('explorer_node', **options)
        self.params = declare_parameters(self)
        self._display = display.Display(self)
        self._changed: set[str] = set()  # kinds whose newest message was not shown yet
        self._states = NodeStates()
        self._tasks = names('tap_ros.tasks')  # once: it reads files of all installed packages
        self._task = self.params['task']
        self._seed: int | None = None  # of the scene, once it is told
        self._scenes = 0  # that have begun
        self._begun_ns = time.time_ns()
        # The newest subgoal, in words; whether the arm has moved since, or may have.
        self._subgoal, self._passed = '', False
        self._scene_ns = 0  # subgoals and plans of pictures before that are of an old scene
        kind, topic = camera_image(self.params)
        self._diagnostics = Diagnostics(
            self, [topic, 'objects'], ['goal/image', 'goal/objects'])
        self._calls = ExplorerCalls(
            self, self._display, self._diagnostics.error, self._forget_predictions)
        self._server = ExplorerServer(
            self._calls.do, self.params['host'], self.params['port'], self.params['token'])
        adapt_regularly(self, [
            self._keep(Image, OBSERVER, 'observer', STREAM, counted=False),
            self._keep(Image, 'plan/overlay', 'plan', STREAM, counted=False),
            self._keep(kind, topic, 'camera', STREAM),
            self._keep(Image, 'goal/image', 'goal', LATCHED),
            self._keep(Subgoal, 'subgoal', 'subgoal', LATCHED, counted=False),
            self._keep(ObjectStates, 'objects', 'objects', STREAM),
            self._keep(ObjectStates, 'goal/objects', 'goal_objects', LATCHED),
            self._keep(ObjectStates, 'truth/goal/objects', 'true_goals', LATCHED, counted=False),
            AdaptiveSubscription(self, Episode, 'episode', self._on_episode, STREAM),
            AdaptiveSubscription(
                self, ImageMarker, 'objects/outlines', self._on_outline, STREAM),
            AdaptiveSubscription(
                self, DiagnosticArray, '/diagnostics', self._on_diagnostics, STREAM)])
        steady_timer(self, PERIOD_S, self._show)
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

    def _keep(self, kind: type, topic: str, name: str, qos: Any,
              counted: bool = True) -> AdaptiveSubscription:
        """Keep the newest message of a topic."""
        def keep(message: Any, info: Mapping[str, Any]) -> None:
            if counted:
                self._diagnostics.received(topic)
            with self._display.lock:
                newest = self._display.newest
                before, _ = newest.get(name, (None, 0.0))
                if name == 'goal' and is_empty(message):  # it was taken back
                    self._forget('goal')
                    return
                if name == 'goal' and before not in (None, message):
                    self._forget('subgoal', 'plan')  # they are for another goal
                    self._calls.forget_end()
                if name in OF_A_SCENE and self._is_old(message):
                    return
                if name == 'objects' and before and _names(before) != _names(message):
                    self._forget('subgoal', 'plan')  # they are of other objects
                if name == 'subgoal':
                    self._passed = 0 < info.get('source_timestamp', 0) < self._begun_ns
                if name == 'goal_objects' and before and _places(before) != _places(message):
                    self._calls.forget_end()  # of a goal that somebody has moved since
                newest[name] = message, reception_time(info)
                if message != before:  # one that is sent again is shown already
                    self._changed.add(name)
        return AdaptiveSubscription(self, kind, topic, keep, qos)

    def _forget(self, *kinds: str) -> None:
        """Show some pictures no more."""
        for kind in kinds:
            self._display.newest.pop(kind, None)
            self._changed.discard(kind)
            self._server.put(kind, b'')

    def _forget_predictions(self) -> None:
        """Show what was predicted no more: it is of other objects."""
        with self._display.lock:
            self._forget('subgoal', 'plan')

    def _on_episode(self, message: Episode) -> None:
        if message.event == Episode.START:
            self._task, self._seed = escaped(message.task, 40), message.seed
            self._display.events.add(f'scene: {self._task}, seed {self._seed}')
            self._calls.forget_end()
            self._scenes += 1
            with self._display.lock:
                self._display.selection = display.NOTHING_SELECTED
                self._display.outlines.clear()
                if self._calls.offered('reset'):  # stamps are the simulator's
                    self._scene_ns = to_nanoseconds(message.header.stamp)
                self._forget('subgoal', 'plan')
                for kind in ('objects', 'goal_objects'):
                    if self._is_old(self._display.newest.get(kind, [ObjectStates()])[0]):
                        self._display.newest.pop(kind)

    def _on_outline(self, message: ImageMarker) -> None:
        """Keep the outline of an object; one that cannot be drawn is passed over."""
        outlines = self._display.outlines
        if len(message.points) > MOST_POINTS or not all(
                math.isfinite(point.x + point.y) for point in message.points):
            return
        if message.ns not in outlines and len(outlines) >= MAX_OBJECTS:
            outlines.clear()
        outlines[message.ns] = message

    def _is_old(self, message: Any) -> bool:
        """Return whether a message is of an old scene; not with stamp 0, as that of a file."""
        return 0 < to_nanoseconds(message.header.stamp) < self._scene_ns

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._states.take(message, time.monotonic())

    # What is shown

    def _show(self) -> None:
        """Bring what browsers see up to date."""
        # Before the events: how a run ended is told first, so that who sees no run sees how.
        calls, shown = self._calls, self._display
        running = calls.running
        stage = calls.stage if running else ''
        self._passed |= running
        self._server.put('selection', shown.selection)
        shown.events.look()
        self._server.put('events', shown.events.text)
        if not self._server.browsers:
            return
        with shown.lock:
            newest, changed, self._changed = dict(shown.newest), self._changed, set()
        for kind in changed & {*PICTURES}:
            image = shown.picture(kind)
            if image is None:
                self._server.put(kind, b'')
            else:
                shown.sizes[kind] = image.shape[1], image.shape[0]
                self._server.put(kind, picture_bytes(image, kind == 'plan'))
        if 'subgoal' in changed:
            self._subgoal = shown.subgoal()
        objects, goals = shown.places('objects'), shown.places('goal_objects')
        first = running and calls.to_subgoal
        targets = shown.expected() if first else goals
        now, simulator, tracker = (
            time.monotonic(), calls.offered('reset'), calls.offered('select'))
        self._server.put('state', json.dumps({
            'kind': 'state', 'tasks': self._tasks, 'task': self._task,
            'seed': self._seed, 'scene': self._scenes, 'simulator': simulator, 'tracker': tracker,
            'predictor': calls.offered('predict'), 'planner': calls.offered('cancel'),
            'plans': not simulator or not display.grips(self._task),
            'observer': self.count_publishers(OBSERVER) > 0,
            'movable': '' if running else self._movable(
                bool(objects), bool(goals), 'goal' in newest),
            'camera': {**shown.size('camera'),
                       'objects': display.listed(
                           objects, newest.get('objects', [None])[0], shown.outlines.copy()),
                       'targets': display.listed(
                           {each: targets[each] for each in objects if each in targets}),
                       'note': display.silence(now, newest.get('camera')),
                       'objects_note': display.silence(now, newest.get('objects'))},
            'subgoal': self._subgoal, 'passed': self._passed and not running,
            'goal': {**shown.size('goal'),
                     'objects': display.listed(goals, newest.get('goal_objects', [None])[0]),
                     'pictured': 'goal' in newest},
            'problem': shown.events.problem, 'events': shown.events.count,
            'run': {'running': running, 'stage': stage, 'to_subgoal': first,
                    **calls.end},
            'nodes': self._states.lines(now, self._present, tracker)}))

    def _present(self) -> set[str]:
        """Return the full names of the nodes that may say how they are."""
        (_, publishers), = publishers_of(self, '/diagnostics').items()
        return set().union(*publishers.values())

    def _movable(self, objects: bool, goals: bool, pictured: bool) -> str:
        """Return in which picture objects can be dragged to their goals; '' in none."""
        if self._calls.offered('set_goal') and goals:
            return 'goal'
        if not objects or (self._calls.offered('reset') and not self._calls.offered('select')):
            return ''
        return 'goal' if pictured else 'camera'


def _names(message: ObjectStates) -> set[str]:
    return {one.name for one in message.objects}


def _places(message: ObjectStates) -> list[tuple[str, float, float]]:
    """Return where a message says that objects are."""
    return [(one.name, one.u, one.v) for one in message.objects]


@dataclass(frozen=True)
class ExplorerParameters:
    """
    Parameters that this node alone has.

    :param host: Address at which browsers find the page. One that is not of this machine alone,
        such as 0.0.0.0, needs a token.
    :param port: Port of the page; 0: any that is free.
    :param token: That browsers must give as ?token=...; empty: none is needed where host is of
        this machine alone, else one is made up and printed.
    :param task: Of the simulator's first scene; resets are heard.
    """

    host: str = '127.0.0.1'
    port: int = setting(8000, between=(0, 65535))
    token: str = ''
    task: str = ''


def declare_parameters(node: Node) -> Parameters:
    """Declare the parameters of the node."""
    parameters = Parameters(node)
    parameters.declare_fields(ExplorerParameters)
    parameters.declare_shared('image_transport')
    return parameters
