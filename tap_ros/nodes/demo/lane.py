# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scenes run by nodes in processes of their own, in two modes side by side."""

from collections.abc import Container, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
import math
from pathlib import Path
import re
from typing import Any, TYPE_CHECKING

import numpy as np
from rclpy.parameter import Parameter
from sim_bridge.collect import TABLE
from sim_bridge.tasks.tasks import get_task, sample_scene
from tap_ros.contract import step_budget
from tap_ros.errors import TapError
from tap_ros.messages.images import decode_image
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.subgoals import decode_subgoal
from tap_ros.nodes.client import Client, positions_of
from tap_ros.nodes.demo.film import GOAL, Run, Scene
from tap_ros.nodes.demo.report import MODES
from tap_ros.nodes.demo.watch import click, Refused, Watch
from tap_ros.nodes.node_processes import NodeProcesses
from tap_ros.robots.arm import get_arm
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS

if TYPE_CHECKING:
    from tap_ros.nodes.demo.command import Options

CAMERA_SIZE = 256  # px of the camera's pictures; networks are shown what they were trained on
CALL_S, STEP_S = 60.0, 15.0  # that a call, and one step of a run, may take, far more than usual
LOOK_S = 1.0  # between two looks whether all nodes run
RESEND_S = 0.5  # sending pictures again takes time from plans
# In lock-step nothing moves while a node waits, so a busy machine changes nothing but the time.
PATIENT = {'image_timeout': 300.0, 'max_age': 300.0, 'max_silence': 60.0,
           'predictor_timeout': CALL_S}


class Lane:
    """
    A set of nodes that runs scenes in one mode, in a thread of its own.

    :param folder: of the logs and the recording.
    :param mode: one of MODES.
    :param filmed: tasks of which there is a film, so that no more pictures are needed.
    """

    def __init__(self, args: 'Options', folder: Path, mode: str, filmed: Container[str]) -> None:
        self._args, self._mode, self._filmed, (self._task, _) = args, mode, filmed, args.plan[0]
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
        start('sim_node', lock_step=True, resend_period=RESEND_S, task=self._task, **world)
        if args.tracked:
            start('tracker_node', patience=CALL_S)
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
        # An object that is lost on the way ends the run, and not the demo.
        if result.end != 'succeeded' and not (args.tracked and told):
            raise TapError(f'reach_goal ({mode}): {result.message}')
        heading = [_heading(feedback.stage) for feedback in told]
        seen = watch.since(start.stamp_ns, result.steps + 1, watch.truth,
                           *[watch.view] * filming)
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
               filmed: Container[str]) -> Iterator[Scene | Refused]:
    """Run all scenes, both modes at the same time; see Lane."""
    lanes = [Lane(args, folder, mode, filmed) for mode in MODES]
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
