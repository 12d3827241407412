# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes run by nodes in processes of their own, in two modes side by side."""

from collections.abc import Container, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
import math
from pathlib import Path
import re
import threading
from typing import Any, TYPE_CHECKING

import numpy as np
from rclpy.parameter import Parameter
from sim_bridge.collect import TABLE
from sim_bridge.tasks.tasks import get_task, sample_scene
from tap_ros.apps.demo.film import GOAL, Run, Scene
from tap_ros.apps.demo.report import MODES
from tap_ros.apps.demo.watch import click, Refused, Watch
from tap_ros.apps.node_processes import NodeEnded, NodeProcesses
from tap_ros.base.contract import step_budget
from tap_ros.base.errors import TapError
from tap_ros.base.files import free_folder
from tap_ros.messages.images import decode_image
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.robots.arm import get_arm
from tap_ros.ros.client import Client
from tap_ros.ros.views import positions_of
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS

if TYPE_CHECKING:
    from tap_ros.apps.demo.command import Options

CAMERA_SIZE = 256  # px of the camera's pictures; networks are shown what they were trained on
CALL_S, STEP_S = 60.0, 15.0  # that a call, and one step of a run, may take, far more than usual
FOLLOWED_NO_MORE = 'select the objects again'  # what reach_goal says of a lost object
LOOK_S = 1.0  # between two looks whether all nodes run
RESEND_S = 0.5  # sending pictures again takes time from plans
# In lock-step nothing moves while a node waits, so a busy machine changes nothing but the time.
PATIENT = {'image_timeout': 300.0, 'max_age': 300.0, 'max_silence': 60.0,
           'predictor_timeout': CALL_S}


class Lane:
    """
    A set of nodes that runs scenes in one mode, in a thread of its own.

    Whatever ends a scene before its end, the next one begins with new nodes.

    :param folder: of the logs and the recording.
    :param mode: one of MODES.
    :param filmed: tasks of which there is a film, so that no more pictures are needed.
    """

    def __init__(self, args: 'Options', folder: Path, mode: str, filmed: Container[str]) -> None:
        self._args, self._folder, self._mode, self._filmed = args, folder, mode, filmed
        self._task, _ = args.plan[0]
        self.pool = ThreadPoolExecutor(1, 'lane')
        self._pushing = ThreadPoolExecutor(1, 'pushing')
        self._lock, self._closed = threading.Lock(), False
        self._nodes: ExitStack | None = None  # with client and processes, while they are there

    def start(self) -> None:
        """Start the nodes and a client."""
        args, table = self._args, self._args.world == TABLE
        subgoals = self._mode == 'subgoal'
        namespace = '' if subgoals else f'/{self._mode}'
        world: dict[str, Any] = {'look': args.look, 'arm': args.arm, 'observer': True} if (
            table) else {'world': args.world}
        if args.tracked:
            world |= {'objects': 'tracked', 'image_size': CAMERA_SIZE}
        with self._lock:
            if self._closed:
                raise TapError('the demo is ending')
            self._nodes = ExitStack()
            self._client = self._nodes.enter_context(Client(namespace, CALL_S))
            self._watch = Watch(self._client, args.tracked, 'observer/image_raw' if table else
                                'camera/image_raw')
            self._processes = self._nodes.enter_context(NodeProcesses(
                free_folder(self._folder / 'logs' / self._mode), namespace))
            start = self._processes.start
            if subgoals:
                start('recorder_node', folder=free_folder(self._folder / 'recording'))
            start('sim_node', lock_step=True, resend_period=RESEND_S, task=self._task, **world)
            if args.tracked:
                start('tracker_node', patience=CALL_S)
            if subgoals:
                start('predictor_node', robot_mask=args.robot_mask,
                      weights=self._weights(self._task))
            start('visual_mpc_node', weights=args.forward_model, robot_mask=args.robot_mask,
                  preset='quick', subgoal_rounds=self._rounds(self._task), **PATIENT)

    def wait_until_ready(self) -> None:
        """Wait until the nodes are ready."""
        self._processes.wait_until_ready()

    def run(self, task: str, seed: int) -> Scene | TapError:
        """Push the objects of a scene; return why not, where it cannot be finished."""
        try:
            if self._nodes is None:
                self._task = task
                self.start()
                self.wait_until_ready()
            pushing = self._pushing.submit(self._push, task, seed)
            try:
                while not wait([pushing], LOOK_S).done:
                    self._processes.check()
            except NodeEnded:
                self._processes.end()  # this ends what waits for them, too
                wait([pushing])
                raise
            return pushing.result()
        except TapError as error:
            if not isinstance(error, Refused):
                self._end_nodes()
            return error

    def close(self) -> None:
        """End the nodes, and run no more scenes."""
        with self._lock:
            self._closed = True
        self.pool.shutdown(wait=False, cancel_futures=True)
        if self._nodes is not None:
            self._processes.end()
        self.pool.shutdown()
        self._pushing.shutdown()
        self._end_nodes()

    def _end_nodes(self) -> None:
        if self._nodes is not None:
            self._nodes.close()
            self._nodes = None

    def _weights(self, task: str) -> str:
        return self._args.predictor or (task if task in PREDICTORS else DEFAULT_PREDICTOR)

    def _rounds(self, task: str) -> int:
        """Return how often a subgoal is predicted: while more than one object is to be moved."""
        return max(1, self._args.num_objects(task) - 1)

    def _change(self, task: str) -> None:
        """Go on with another task."""
        if self._mode == 'subgoal' and self._weights(task) != self._weights(self._task):
            self._client.use_weights(self._weights(task))
        self._client.call('set_planner', parameters=[
            Parameter('subgoal_rounds', value=self._rounds(task)).to_parameter_msg()])
        self._task = task

    def _push(self, task: str, seed: int) -> Scene:
        """Start a scene and have the arm push until its goal is reached or the budget spent."""
        args, client, watch, mode = self._args, self._client, self._watch, self._mode
        if task != self._task:
            self._change(task)
        filming = task not in self._filmed
        watch.film(filming)
        watch.clear()
        start, goal = client.reset(task, seed, objects=not args.tracked)
        placed: dict[str, Any] = {}
        if args.tracked:
            start, goal, placed = click(client, watch, seed, start, goal)
        if filming:
            watch.at(watch.view, start.stamp_ns)  # before anything moves
        budget = args.step_budget or step_budget(args.num_objects(task))
        reaching = client.reach(mode=mode, step_budget=budget, seed=seed, goal_pixels=placed,
                                timeout_s=client.timeout_s + STEP_S * budget)
        told = list(reaching)
        result = reaching.result()
        # An object that cannot be followed any more is an end as good as any.
        if result.end != 'succeeded' and not (told and FOLLOWED_NO_MORE in result.message):
            raise TapError(f'reach_goal ({mode}): {result.message}')
        heading = [_heading(feedback.stage) for feedback in told]
        seen = watch.since(start.stamp_ns, result.steps + 1, watch.truth,
                           *[watch.view] * filming)
        if len(seen) <= result.steps:
            raise TapError(f'{watch.truth}, {watch.view}: {len(seen)} of {result.steps + 1} '
                           'moments came')
        truth = [objects for objects, *_ in seen]
        subgoals = watch.since(start.stamp_ns, max(heading, default=GOAL) + 1, 'subgoal')
        positions = np.array([positions_of(objects) for objects in truth])
        return Scene(
            task, seed, goal.image, start.pixels, goal.pixels,
            right_order(task, seed, args.arm) if args.world == TABLE else (), {mode: Run(
                np.linalg.norm(positions - goal.positions, axis=-1),
                [decode_image(image, watch.view) for _, image in seen] if filming else
                [start.image, client.camera(to_nanoseconds(truth[-1].header.stamp) - 1).image],
                np.array([decode_objects(objects, watch.truth)[1] for objects in truth]),
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


def run_scenes(args: 'Options', folder: Path,
               filmed: Container[str]) -> Iterator[Scene | TapError]:
    """
    Run all scenes, both modes at the same time; see Lane.

    :return: each scene, or why it could not be finished.
    :raises TapError: when the nodes cannot be started at all.
    """
    lanes = [Lane(args, folder, mode, filmed) for mode in MODES]
    with ExitStack() as stack:
        for lane in lanes:
            stack.callback(lane.close)
        for step in (Lane.start, Lane.wait_until_ready):
            for lane in lanes:
                step(lane)
        running = [[lane.pool.submit(lane.run, *scene) for scene in args.plan] for lane in lanes]
        for futures in zip(*running):
            direct, via = (future.result() for future in futures)
            if isinstance(direct, Scene) and isinstance(via, Scene):
                yield replace(via, runs=direct.runs | via.runs)
            else:
                yield direct if isinstance(direct, TapError) else via
