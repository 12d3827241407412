# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes run by nodes in processes of their own, in two modes side by side."""

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
import math
from pathlib import Path
import re
import time
from typing import Any, TYPE_CHECKING

import numpy as np
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from sim_bridge.collect import TABLE
from sim_bridge.tasks.tasks import get_task, sample_scene
from tap_msgs.msg import ObjectStates, Subgoal
from tap_ros.contract import step_budget
from tap_ros.errors import TapError
from tap_ros.messages.images import decode_image, decode_mask
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.nodes.calls import CallError
from tap_ros.nodes.client import Client, positions_of, View
from tap_ros.nodes.demo.film import GOAL, Run, Scene
from tap_ros.nodes.demo.report import MODES
from tap_ros.nodes.node_processes import NodeProcesses
from tap_ros.nodes.topics import LATCHED, STREAM
from tap_ros.robots.arm import get_arm
from tap_ros.tracking.protocols import LOST
from tap_ros.training.robot_mask import nearest_free
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS

if TYPE_CHECKING:
    from tap_ros.nodes.demo.command import Options

CAMERA_SIZE = 256  # px of the camera's pictures; networks are shown what they were trained on
CALL_S, STEP_S = 60.0, 15.0  # that a call, and one step of a run, may take, far more than usual
LOOK_S = 1.0  # between two looks whether all nodes run
# In lock-step nothing moves while a node waits, so a busy machine ends no goal of the planner.
PATIENT = {'image_timeout': 300.0, 'max_age': 300.0, 'max_silence': 60.0,
           'predictor_timeout': CALL_S}
FOUND_S = 10.0  # that the tracker may take to find the objects of a goal
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
        streams = {view: Image, self.truth: ObjectStates}
        latched = {'subgoal': Subgoal, 'goal/objects': ObjectStates, self.true_goal: ObjectStates}
        if tracked:
            streams['camera/robot_mask'] = Image
        self._kept: dict[str, dict[int, Any]] = {topic: {} for topic in {**streams, **latched}}
        self._timeout_s = client.timeout_s
        for topics, qos in ((streams, STREAM), (latched, LATCHED)):
            for topic, kind in topics.items():
                client.node.create_subscription(kind, topic, partial(self._keep, topic), qos)

    def clear(self) -> None:
        """Forget the scenes before."""
        for kept in self._kept.values():
            kept.clear()

    def at(self, topic: str, stamp_ns: int, timeout_s: float = 0.0) -> Any | None:
        """Return the message of a stamp, None where it does not come in time."""
        self.until(lambda: stamp_ns in self._kept[topic], timeout_s)
        return self._kept[topic].get(stamp_ns)

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
        deadline = time.monotonic() + (timeout_s or self._timeout_s)
        while not done() and time.monotonic() < deadline:
            time.sleep(0.02)

    def _keep(self, topic: str, message: Any) -> None:
        self._kept[topic][to_nanoseconds(message.header.stamp)] = message


class Lane:
    """
    A set of nodes that runs scenes in one mode, in a thread of its own.

    :param folder: of the logs and the recording.
    :param mode: one of MODES.
    """

    def __init__(self, args: 'Options', folder: Path, mode: str) -> None:
        self._args, self._mode, (self._task, _) = args, mode, args.plan[0]
        namespace = '' if mode == 'subgoal' else f'/{mode}'
        self.client = Client(namespace, CALL_S)
        self.watch = Watch(self.client, args.tracked, 'observer/image_raw' if args.world == TABLE
                           else 'camera/image_raw')
        self.pool = ThreadPoolExecutor(1, 'lane')
        self.processes = NodeProcesses(folder / 'logs' / mode, namespace)
        self._recording = folder / 'recording'

    def start(self) -> None:
        """Start the nodes."""
        args, table = self._args, self._args.world == TABLE
        start, subgoals = self.processes.start, self._mode == 'subgoal'
        world: dict[str, Any] = {'look': args.look, 'arm': args.arm, 'observer': True} if (
            table) else {'world': args.world}
        if args.tracked:
            world |= {'objects': 'tracked', 'image_size': CAMERA_SIZE}
        if subgoals:
            start('recorder_node', folder=self._recording)
        start('sim_node', lock_step=True, task=self._task, **world)
        if args.tracked:
            start('tracker_node')
        if subgoals:
            start('predictor_node', robot_mask=args.robot_mask, weights=self._weights(self._task))
        start('visual_mpc_node', weights=args.forward_model, robot_mask=args.robot_mask,
              preset='quick', subgoal_rounds=self._rounds(self._task), **PATIENT)

    def run(self, task: str, seed: int) -> Scene | Refused:
        """Push the objects of a scene, unless clicks are refused."""
        if task != self._task:
            self._change(task)
        try:
            return self._push(task, seed)
        except Refused as error:
            return error

    def _weights(self, task: str) -> str:
        return self._args.predictor or (task if task in PREDICTORS else DEFAULT_PREDICTOR)

    def _rounds(self, task: str) -> int:
        """Return how often a subgoal is predicted: while more than one object is to be moved."""
        return max(1, self._args.num_objects(task) - 1)

    def _change(self, task: str) -> None:
        """Go on with another task."""
        if self._mode == 'subgoal' and self._weights(task) != self._weights(self._task):
            self.client.use_weights(self._weights(task))
        self.client.call('set_planner', parameters=[
            Parameter('subgoal_rounds', value=self._rounds(task)).to_parameter_msg()])
        self._task = task

    def _push(self, task: str, seed: int) -> Scene:
        """Start a scene and have the arm push until its goal is reached or the budget spent."""
        args, client, watch, mode = self._args, self.client, self.watch, self._mode
        watch.clear()
        start, goal = client.reset(task, seed, objects=not args.tracked)
        placed: dict[str, Any] = {}
        if args.tracked:
            start, goal, placed = click(client, watch, seed, start, goal)
        budget = args.step_budget or step_budget(args.num_objects(task))
        reaching = client.reach(mode=mode, step_budget=budget, seed=seed, goal_pixels=placed,
                                timeout_s=client.timeout_s + STEP_S * budget)
        told = list(reaching)
        result = reaching.result()
        # An object that is lost on the way ends the run, and not the demo.
        if result.end != 'succeeded' and not (args.tracked and told):
            raise TapError(f'reach_goal ({mode}): {result.message}')
        heading = [_heading(feedback.stage) for feedback in told]
        seen = watch.since(start.stamp_ns, result.steps + 1, watch.view, watch.truth)
        subgoals = watch.since(start.stamp_ns, max(heading, default=GOAL) + 1, 'subgoal')
        positions = np.array([positions_of(objects) for _, objects in seen])
        return Scene(
            task, seed, goal.image, start.pixels, goal.pixels,
            right_order(task, seed, args.arm) if args.world == TABLE else (), {mode: Run(
                np.linalg.norm(positions - goal.positions, axis=-1),
                [decode_image(image, watch.view) for image, _ in seen],
                np.array([decode_objects(objects, watch.truth)[1] for _, objects in seen]),
                heading,
                [decode_subgoal(one, start.names, (one.image.height, one.image.width))
                 for one, in subgoals] if mode == 'subgoal' else [],
                result.message,
                float(np.median([feedback.planning_ms for feedback in told] or [math.nan])))})


def _heading(stage: str) -> int:
    """Return which subgoal a stage that feedback names is, or GOAL."""
    number = re.search(r'\d+', stage)
    return GOAL if stage == 'goal' else int(number[0]) - 1 if number else 0


def right_order(task: str, seed: int, arm: str) -> tuple[int, ...]:
    """Return the only order of the objects that works; () where any does."""
    if not get_task(task).ordered:
        return ()
    limits = get_arm(arm)
    return tuple(sample_scene(get_task(task), seed, 1.0, limits.low, limits.high).order)


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
            client.select(dict(zip(names, nearest_free(places, hidden).tolist())))
            found = watch.at('goal/objects', goal.stamp_ns, FOUND_S)
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


def run_scenes(args: 'Options', folder: Path) -> Iterator[Scene | Refused]:
    """Run all scenes, both modes at the same time."""
    lanes = [Lane(args, folder, mode) for mode in MODES]
    with ExitStack() as stack:  # nodes end first, which ends what waits for them
        for lane in lanes:
            stack.enter_context(lane.client)
            stack.callback(lane.pool.shutdown, cancel_futures=True)
        for lane in lanes:
            stack.enter_context(lane.processes)
            lane.start()
        for lane in lanes:
            lane.processes.wait_until_ready()
        running = [[lane.pool.submit(lane.run, *scene) for scene in args.plan] for lane in lanes]
        for futures in zip(*running):
            while (looked := wait(futures, LOOK_S, FIRST_EXCEPTION)).not_done:
                for lane in lanes:
                    lane.processes.check()
                for future in looked.done:
                    future.result()  # raises what has ended it
            direct, via = (future.result() for future in futures)
            if isinstance(direct, Scene) and isinstance(via, Scene):
                yield replace(via, runs=direct.runs | via.runs)
            else:
                yield direct if isinstance(direct, Refused) else via
