# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is seen of the demo's scenes, and the clicks with which a user would begin."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import re
import time
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.apps.demo.film import GOAL, Run
from tap_ros.base.contract import LOST, SUCCESS_DISTANCE
from tap_ros.base.errors import TapError
from tap_ros.images.robot_mask import nearest_free
from tap_ros.messages.images import decode_image, decode_mask
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.ros.calls import CallError
from tap_ros.ros.client import Client
from tap_ros.ros.reaching import ReachResult
from tap_ros.ros.topics import LATCHED
from tap_ros.ros.views import positions_of, View

# Nothing is lost while this process, which also draws films, is held up.
STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
FOLLOWED_NO_MORE = 'select the objects again'  # what reach_goal says of a lost object
CLICKS, SLIP = 5, 0.015  # tries to click; how far beside the first the others are, of a picture


class Refused(TapError):
    """The tracker cannot tell an object from the table."""


class Watch:
    """
    Keep what is seen of a scene, by topic and stamp.

    :param client: whose node another thread spins.
    :param tracked: whether objects and goal/objects are the tracker's, and the truth is beside.
    :param view: topic of the pictures that people are shown.
    :ivar truth: topic of the true objects; true_goal: of those of the goal.
    """

    def __init__(self, client: Client, tracked: bool, view: str) -> None:
        beside = 'truth/' if tracked else ''
        self.truth, self.true_goal, self.view = f'{beside}objects', f'{beside}goal/objects', view
        streams = {self.truth: ObjectStates}
        latched = {'subgoal': Subgoal, 'goal/objects': ObjectStates, self.true_goal: ObjectStates}
        if tracked:
            streams['camera/robot_mask'] = Image
        self._kept: dict[str, dict[int, Any]] = {topic: {} for topic in {view, *streams, *latched}}
        self._client = client
        self._film: Any = None  # the subscription to the view
        for topics, qos in ((streams, STREAM), (latched, LATCHED)):
            for topic, kind in topics.items():
                client.node.create_subscription(kind, topic, partial(self._keep, topic), qos)

    def film(self, on: bool) -> None:
        """Keep the view, or not: then the simulator does not draw it either."""
        if on and self._film is None:
            self._film = self._client.node.create_subscription(
                Image, self.view, partial(self._keep, self.view), STREAM)
        elif not on and self._film is not None:
            self._client.node.destroy_subscription(self._film)
            self._film = None

    def clear(self) -> None:
        """Forget the scenes before."""
        for kept in self._kept.values():
            kept.clear()

    def at(self, topic: str, stamp_ns: int, timeout_s: float = 0.0,
           accept: Callable[[Any], object] = lambda _: True) -> Any | None:
        """Return the message of a stamp, None where none that is accepted comes in time."""
        def found() -> Any | None:
            message = self._kept[topic].get(stamp_ns)
            return message if message is not None and accept(message) else None

        self.until(lambda: found() is not None, timeout_s)
        return found()

    def since(self, first_ns: int, count: int, *topics: str) -> list[tuple[Any, ...]]:
        """Return the first messages on all of some topics from a stamp on, in their order."""
        def found() -> list[tuple[Any, ...]]:
            kept = [dict(self._kept[topic]) for topic in topics]
            return [tuple(messages[stamp] for messages in kept)
                    for stamp in sorted(set.intersection(*map(set, kept))) if stamp >= first_ns]
        self.until(lambda: len(found()) >= count)
        return found()[:count]

    def until(self, done: Callable[[], bool], timeout_s: float = 0.0) -> None:
        """Wait until something has come."""
        deadline = time.monotonic() + (timeout_s or self._client.timeout_s)
        while not done() and time.monotonic() < deadline:
            time.sleep(0.02)

    def run(self, start: View, goal: View, feedback: Sequence[Any], result: ReachResult) -> Run:
        """
        Return what was seen of an attempt.

        :param start: the first picture; goal: with true positions.
        :param feedback: of every step; result: of the goal.
        :raises TapError: where moments are missing.
        """
        filming, steps = self._film is not None, result.steps
        seen = self.since(start.stamp_ns, steps + 1, self.truth, *[self.view] * filming)
        if len(seen) <= steps:
            raise TapError(f'{self.truth}, {self.view}: {len(seen)} of {steps + 1} moments came')
        truth = [objects for objects, *_ in seen]
        pictures = [decode_image(image, self.view) for _, image in seen] if filming else [
            start.image, self._client.camera(to_nanoseconds(truth[-1].header.stamp) - 1).image]
        numbers = [(one.stage, re.search(r'\d+', one.stage)) for one in feedback]
        heading = [GOAL if stage == 'goal' else int(number[0]) - 1 if number else 0
                   for stage, number in numbers]
        subgoals = self.since(start.stamp_ns, max(heading, default=GOAL) + 1, 'subgoal')
        positions = np.array([positions_of(objects) for objects in truth])
        return Run(
            np.linalg.norm(positions - goal.positions, axis=-1), pictures,
            np.array([decode_objects(objects, self.truth)[1] for objects in truth]), heading,
            [decode_subgoal(one, start.names) for one, in subgoals], result.message,
            float(np.median([one.planning_ms for one in feedback] or [np.nan])))

    def _keep(self, topic: str, message: Any) -> None:
        self._kept[topic][to_nanoseconds(message.header.stamp)] = message


def click(client: Client, watch: Watch, seed: int, start: View,
          goal: View) -> tuple[View, View, dict[str, Any]]:
    """
    Stand in for the user: click on each object, and on those not found in the goal picture.

    Where a click is refused, others are tried beside it.

    :return: the first picture and the goal, with the objects as the nodes know them, the goal with
        true positions; goal pixels by name if the goal has objects that the tracker did not find.
    :raises Refused: after CLICKS tries.
    """
    true, wanted = (watch.at(topic, view.stamp_ns) for topic, view in (
        (watch.truth, start), (watch.true_goal, goal)))
    if true is None or wanted is None:
        raise TapError(f'{watch.truth}: nothing came')
    names, clicks = decode_objects(true, watch.truth)
    mask = watch.at('camera/robot_mask', start.stamp_ns)
    hidden = np.zeros(start.image.shape[:2], np.uint8) if mask is None else decode_mask(mask)
    rng, tries, places = np.random.default_rng(seed), 0, clicks
    deadline, found = time.monotonic() + client.timeout_s, None
    while found is None:
        try:  # right after a reset the tracker may not have heard of the scene yet
            client.select(dict(zip(names, nearest_free(places, hidden).tolist())), start.stamp_ns)
            found = watch.at('goal/objects', goal.stamp_ns, accept=lambda one: len(
                one.objects) == len(names))
            if found is None:
                raise TapError('goal/objects: nothing came')
        except CallError as error:
            if 'click on an object' in str(error):
                tries += 1
                places = clicks + rng.normal(0, SLIP * len(start.image), clicks.shape)
                if tries == CLICKS:
                    raise Refused(str(error)) from error
            elif time.monotonic() > deadline:
                raise
            else:
                time.sleep(0.2)
    true_goals = dict(zip(*decode_objects(wanted, watch.true_goal)))
    told = dict(zip(*decode_objects(found, 'goal/objects')))
    lost = [one.name for one, state in zip(found.objects, found.states) if state == LOST]
    goal_pixels = told | {name: true_goals[name] for name in lost}
    start = client.camera(start.stamp_ns - 1)
    goal = replace(goal, names=names, pixels=np.array([goal_pixels[name] for name in names]),
                   positions=positions_of(wanted))
    return start, goal, goal_pixels if lost else {}


def right_order(starts: np.ndarray, goals: np.ndarray) -> tuple[int, ...]:
    """
    Return the only order of the objects that works: each stands on the goal of the next.

    :param starts: (K, 3) m, where objects stand; goals: (K, 3).
    :return: numbers of the objects; () where they are no such chain.
    """
    on = np.linalg.norm(starts[:, None] - goals, axis=-1) < SUCCESS_DISTANCE
    np.fill_diagonal(on, False)
    free = np.flatnonzero(~on.any(0)).tolist()  # those whose goals are
    order = free[:1]
    while len(order) < len(on) and on[order[-1:]].any():
        order.append(int(on[order[-1]].argmax()))
    return tuple(order) if len(free) == 1 < len(order) == len(on) else ()
