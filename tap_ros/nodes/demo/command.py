# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The demo: real nodes in processes of their own push objects to where a goal picture shows them.

Each scene is pushed twice: directly, and via the subgoal that predict_subgoal answers. Everything
goes through the topics, services and actions that any client would use. Where a gripper is needed
the subgoal is predicted only, from true pixels; nothing here plans grasps.

The objects that are pushed are tracked: a click on each in the first picture, here at its true
pixel, and another in the goal picture on what is not found there. Ground truth only measures.
"""

from dataclasses import dataclass, replace
from functools import partial
import math
import os
from pathlib import Path
import platform
import shlex
import sys
import time
from typing import Annotated, Any, Literal, TYPE_CHECKING

import numpy as np
from sensor_msgs.msg import Image
from sim_bridge.collect import TABLE
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, run_episode, task_names
from sim_bridge.world.looks import DEFAULT_LOOK, LOOKS, OBSERVER
from tap_msgs.msg import ObjectStates
from tap_ros.contract import ROBOT_MASKS, step_budget
from tap_ros.errors import ConfigError, TapError
from tap_ros.messages.images import decode_image, decode_mask
from tap_ros.messages.objects import decode_objects
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.nodes.calls import CallError
from tap_ros.nodes.client import Client, positions_of, request_fields, subgoals_of, View
from tap_ros.nodes.demo.report import (
    results_table,
    Run,
    SceneRuns,
    write_film,
    write_report,
)
from tap_ros.nodes.node_processes import NodeProcesses
from tap_ros.nodes.topics import LATCHED, STREAM
from tap_ros.options import Flag, Folder, one_of
from tap_ros.planning.mpc_config import FIRST_SCENE
from tap_ros.plugins import names
from tap_ros.robots.arm import DEFAULT_ARM
from tap_ros.tracking.protocols import LOST
from tap_ros.training.robot_mask import nearest_free
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS
from tqdm import tqdm
from tyro import conf

if TYPE_CHECKING:
    from rclpy.node import Node
    from tap_ros.messages.subgoals import Subgoal

USUAL_TASKS = ('push2', 'order2', 'stack2')
OTHERS_OBJECTS = 1  # of tasks of other worlds
BUDGETS = f'{step_budget(2)} and {step_budget(3)}'  # of two and of three objects
MODES = ('direct', 'subgoal')
TOLD = {  # by whether objects are tracked
    True: 'Objects that are pushed are tracked from a click on each in the first picture (here '
          'its true pixel), and found in the goal picture; the ground truth of the simulator only '
          'measures the distances.',
    False: 'Object pixels at every step, and the distances, are ground truth of the simulator.'}
STEP_TIMEOUT_S = 15.0  # of one step of a run, far more than planning takes
FOUND_S = 10.0  # that the tracker may take to find the objects of a goal
TOPICS = {'camera/image_raw': Image, 'camera/robot_mask': Image, 'observer/image_raw': Image,
          'plan/overlay': Image}


class Watch:
    """
    Keep every camera picture of a scene, the objects in it, and what else is shown for people.

    :param node: rclpy Node that another thread spins.
    :param tracked: whether objects and goal/objects are the tracker's, and the truth is beside.
    :ivar truth: topic of the true objects; true_goal: of those of the goal.
    """

    def __init__(self, node: 'Node', tracked: bool) -> None:
        self.tracked, beside = tracked, 'truth/' if tracked else ''
        self.truth, self.true_goal = f'{beside}objects', f'{beside}goal/objects'
        latched = dict.fromkeys(['goal/objects', self.true_goal], ObjectStates)
        streams = {**TOPICS, self.truth: ObjectStates}
        self._kept: dict[str, dict[int, Any]] = {topic: {} for topic in {**streams, **latched}}
        for topics, qos in ((streams, STREAM), (latched, LATCHED)):
            for topic, kind in topics.items():
                node.create_subscription(kind, topic, partial(self._keep, topic), qos)

    def at(self, topic: str, stamp_ns: int, timeout_s: float) -> Any | None:
        """Return the message of a stamp with objects, None where it does not come in time."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            found = self._kept[topic].get(stamp_ns)
            if found is not None and found.objects:
                return found
            time.sleep(0.05)
        return None

    def since(self, first_ns: int, *topics: str) -> list[tuple[Any, ...]]:
        """Return the messages that came on all of some topics, in order of their stamps."""
        kept = [dict(self._kept[topic]) for topic in topics]
        return [tuple(messages[stamp] for messages in kept)
                for stamp in sorted(set.intersection(*map(set, kept))) if stamp >= first_ns]

    def pictures(self, first_ns: int, topic: str) -> list[np.ndarray]:
        """Return those of one topic, uint8 (H, W, 3)."""
        return [decode_image(image, topic) for image, in self.since(first_ns, topic)]

    def _keep(self, topic: str, message: Any) -> None:
        self._kept[topic][to_nanoseconds(message.header.stamp)] = message


def begin(client: Client, watch: Watch, task: str, seed: int) -> tuple[View, View, dict[str, Any]]:
    """
    Start a scene; where objects are tracked, stand in for the user who clicks on them.

    :return: the first picture and the goal, with the objects as the nodes know them and with true
        positions; goal pixels by name if the goal has objects that the tracker did not find.
    """
    start, goal = client.reset(task, seed, objects=not watch.tracked)
    placed: dict[str, Any] = {}
    if watch.tracked:
        start, goal, placed = click(client, watch, start, goal)
    return start, goal, placed


def click(client: Client, watch: Watch, start: View,
          goal: View) -> tuple[View, View, dict[str, Any]]:
    """Click on each object in the first picture, and on those not found in the goal picture."""
    true, wanted = (watch.at(topic, view.stamp_ns, client.timeout_s) for topic, view in (
        (watch.truth, start), (watch.true_goal, goal)))
    if true is None or wanted is None:
        raise TapError(f'{watch.truth}: nothing came; start sim_node with objects:=tracked, or '
                       'the demo with --objects truth')
    names, clicks = decode_objects(true, watch.truth)
    for mask, in watch.since(start.stamp_ns, 'camera/robot_mask'):  # what is hidden: beside it
        clicks = nearest_free(clicks, decode_mask(mask))
    deadline, found = time.monotonic() + client.timeout_s, None
    while found is None:
        try:  # right after a reset the tracker may not have heard of the scene yet
            client.select(dict(zip(names, clicks.tolist())))
            found = watch.at('goal/objects', goal.stamp_ns, FOUND_S)
        except CallError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    places = dict(zip(*decode_objects(wanted, watch.true_goal)))
    told = dict(zip(*decode_objects(found, 'goal/objects')))
    lost = [one.name for one, state in zip(found.objects, found.states) if state == LOST]
    if lost:
        print(f'    {", ".join(lost)} not found in the goal picture: clicked there', flush=True)
    goal_pixels = told | {name: places[name] for name in lost}
    start = replace(client.camera(start.stamp_ns - 1), positions=positions_of(true))
    goal = replace(goal, names=names, pixels=np.array([goal_pixels[name] for name in names]),
                   positions=positions_of(wanted))
    return start, goal, goal_pixels if lost else {}


def predict(client: Client, placed: dict[str, Any]) -> 'Subgoal':
    """Ask for a subgoal as a person would by hand: empty but for what was clicked in the goal."""
    deadline = time.monotonic() + client.timeout_s
    fields = request_fields(tuple(placed), goal_objects=list(placed.values()) or None)
    while True:
        try:
            subgoal = subgoals_of(client.call('predict', **fields))[0]
            if len(subgoal.object_maps):
                return subgoal
        except CallError:  # right after the start it may not have heard of the simulator yet
            if time.monotonic() > deadline:
                raise
        time.sleep(0.2)


def push(client: Client, watch: Watch, mode: str, seed: int, step_budget: int,
         goal: View, placed: dict[str, Any]) -> Run:
    """Have the arm push until the goal is reached or the budget spent; return the Run."""
    planning_ms = [math.nan]
    reaching = client.reach(mode=mode, step_budget=step_budget, seed=seed, goal_pixels=placed,
                            timeout_s=client.timeout_s + STEP_TIMEOUT_S * step_budget)
    with tqdm(total=step_budget, desc=f'    {mode:<8}', unit='step', leave=False) as bar:
        for feedback in reaching:
            planning_ms.append(feedback.planning_ms)
            bar.set_postfix_str(
                f'to the {feedback.stage}, {feedback.expected_distance:.1f} px expected')
            bar.update(feedback.step - bar.n)
    result = reaching.result()
    # An object that is lost on the way ends the run, and not the demo.
    if result.end != 'succeeded' and not (watch.tracked and len(planning_ms) > 1):
        raise TapError(f'reach_goal ({mode}): {result.message}')
    seen = watch.since(goal.stamp_ns, 'camera/image_raw', watch.truth)
    return Run(
        frames=[decode_image(image, 'camera/image_raw') for image, _ in seen],
        distances=np.array([np.linalg.norm(positions_of(objects) - goal.positions, axis=1)
                            for _, objects in seen]),
        message=result.message, planning_ms=float(np.nanmedian(planning_ms)),
        side=watch.pictures(goal.stamp_ns, 'observer/image_raw'),
        plans=watch.pictures(goal.stamp_ns, 'plan/overlay'))


def run_scene(client: Client, watch: Watch, task: str, seed: int, step_budget: int,
              world: dict[str, str], gripping: bool) -> SceneRuns:
    """
    Predict a subgoal of one scene; push it in every mode, or show how the expert does it.

    :param step_budget: the most steps of a run.
    :param world: options of the world, of the table those of the Simulator.
    :param gripping: whether the task needs the gripper; then nothing is pushed.
    :return: SceneRuns.
    """
    runs: dict[str, Run] = {}
    start, goal, placed = begin(client, watch, task, seed)
    subgoal = predict(client, placed)
    for mode in () if gripping else MODES:
        if runs:
            _, goal, placed = begin(client, watch, task, seed)
        begun = time.monotonic()
        run = runs[mode] = push(client, watch, mode, seed, step_budget, goal, placed)
        print(f'    {mode:<8} {100 * run.distances[0].mean():5.1f} -> '
              f'{100 * run.distances[-1].mean():5.1f} cm in {len(run.frames) - 1} steps, '
              f'{time.monotonic() - begun:.0f} s ({run.planning_ms:.0f} ms a plan)', flush=True)
    return SceneRuns(
        task=task, seed=seed, start=start.image, goal=goal.image, start_pixels=start.pixels,
        goal_pixels=goal.pixels, subgoal=subgoal.image, object_maps=subgoal.object_maps,
        runs=runs,
        side_goal_pixels=None if 'world' in world else OBSERVER.project(goal.positions),
        expert=() if runs else film_expert(task, seed, world))


def film_expert(task: str, seed: int, world: dict[str, Any]) -> list[np.ndarray]:
    """Return pictures from the side of the expert doing a task, without ROS."""
    simulator = Simulator(task, **world)
    try:
        _, actions, _ = run_episode(simulator, seed)
        simulator.reset(seed)
        pictures = [simulator.observer_picture()]
        for action in actions:
            simulator.step(action)
            pictures.append(simulator.observer_picture())
        return pictures
    finally:
        simulator.close()


@dataclass(frozen=True)
class Options:
    """
    Options of the demo.

    :param scenes: how many of each task.
    :param seed: of the first scene of each task.
    :param world: another world, such as metaworld with the task push-v3; its object is pushed by
        weights that were trained there.
    :param predictor: weights, shipped or a file; empty: those of the task.
    :param forward_model: weights of the planner.
    :param robot_mask: what is taken out of pictures, as it was in the training of the weights.
    :param objects: where they come from: tracked, from a click on each in the first picture, or
        truth, the simulator; so it is in another world, and where a gripper is needed.
    :param look: of the world, see sim_node.
    :param arm: at the table, see sim_node.
    :param out: folder for the page, the recording and the logs; a number is added when it exists.
    :param attach: use nodes that run already, for example those of demo.launch.py.
    """

    scenes: int = 2
    seed: int = FIRST_SCENE
    tasks: Annotated[tuple[str, ...], conf.arg(
        help='what is to be done in them; none named: push2, order2 and stack2, or with attach '
             f'push2; of the table {", ".join(task_names())}.')] = ()
    world: Annotated[str, one_of(names('tap_ros.worlds'))] = TABLE
    predictor: str = ''
    forward_model: str = 'push'
    robot_mask: Annotated[str, one_of(ROBOT_MASKS)] = 'none'
    objects: Literal['tracked', 'truth'] = 'tracked'
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
    arm: Annotated[str, one_of(names('tap_ros.arms'))] = DEFAULT_ARM
    step_budget: Annotated[int, conf.arg(
        help=f"most steps of one run; 0: the task's, {BUDGETS}.")] = 0
    out: Folder = 'runs/demo'
    attach: Flag = False


def run(args: Options) -> int:
    """
    Run the demo and leave a recording, logs and a page.

    :param args: Options.
    :return: exit code.
    """
    if args.scenes < 1 or args.step_budget < 0:
        raise ConfigError('scenes must be at least 1, and step-budget 0 or more')
    tasks = args.tasks or (USUAL_TASKS[:1] if args.attach else USUAL_TASKS)
    if args.world != TABLE and not args.tasks:
        raise ConfigError(f'world {args.world}: name its tasks, as --tasks push-v3')
    if len(set(tasks)) < len(tasks):
        raise ConfigError(f'tasks: {" ".join(tasks)}: name each once')
    folder = new_folder(args.out)
    begin = time.monotonic()
    scenes = [scene for task in tasks for scene in run_task(args, task, folder)]
    seconds = time.monotonic() - begin
    pushed = [scene for scene in scenes if scene.runs]
    write_report(
        folder / 'report.html', scenes,
        f'Tasks {", ".join(tasks)}, seeds {args.seed} to {args.seed + args.scenes - 1} of each, '
        f'at most {_budget(args, tasks[0])} steps of a push, {seconds:.0f} s in all. '
        f'{TOLD[any(_tracked(args, task) for task in tasks)]}', {
            'date': time.strftime('%Y-%m-%d %H:%M'),
            'command': shlex.join(['python', '-m', 'tap_ros', *sys.argv[1:]]),
            'machine': f'{platform.machine()}, {os.cpu_count()} CPUs'})
    if pushed:
        write_film(folder / 'demo.webp', pushed)
        print(f'\n{results_table(pushed)}\n')
        print(f'film       {folder / "demo.webp"}')
    if not args.attach:
        print(f'recording  {folder / "recording"}')
    print(f'page       {folder / "report.html"}')
    return 0


def run_task(args: Options, task: str, folder: Path) -> list[SceneRuns]:
    """Run the scenes of one task with nodes of its own, or with those that run already."""
    with NodeProcesses(folder / 'logs' / task) as processes, Client() as client:
        tracked, gripping = _tracked(args, task), _gripping(args, task)
        watch = Watch(client.node, tracked)
        world = {'look': args.look, 'arm': args.arm} if args.world == TABLE else {
            'world': args.world}
        if args.attach:
            print(f'{task}: waiting for the nodes that run already', flush=True)
            client.wait_until_ready(
                'sim_node', 'predictor_node', *['tracker_node'] * tracked,
                *([] if gripping else ['visual_mpc_node']))
        else:
            print(f'{task}: starting nodes; their logs are in {folder / "logs" / task}',
                  flush=True)
            processes.start('recorder_node', folder=folder / 'recording' / task)
            processes.start('sim_node', lock_step=True, task=task, observer=args.world == TABLE,
                            objects='tracked' if tracked else 'truth', **world)
            if tracked:
                processes.start('tracker_node')
            processes.start(
                'predictor_node', robot_mask=args.robot_mask, weights=args.predictor or (
                    task if task in PREDICTORS else DEFAULT_PREDICTOR))
            if not gripping:
                processes.start('visual_mpc_node', weights=args.forward_model,
                                robot_mask=args.robot_mask)
            processes.wait_until_ready()
        scenes = []
        for i in range(args.scenes):
            print(f'  scene {args.seed + i} ({i + 1} of {args.scenes})', flush=True)
            scenes.append(run_scene(
                client, watch, task, args.seed + i, _budget(args, task), world, gripping))
            processes.check()
        return scenes


def _tracked(args: Options, task: str) -> bool:
    """Return whether objects are tracked."""
    return args.objects == 'tracked' and args.world == TABLE and not _gripping(args, task)


def _gripping(args: Options, task: str) -> bool:
    """Return whether a task needs the gripper; of other worlds what is pushed is tried alone."""
    return args.world == TABLE and get_task(task).gripping


def _budget(args: Options, task: str) -> int:
    """Return the most steps of one run."""
    count = get_task(task).num_objects if args.world == TABLE else OTHERS_OBJECTS
    return args.step_budget or step_budget(count)


def new_folder(wanted: str | Path) -> Path:
    """Make a folder of this name, or with the next free number behind it."""
    for number in range(1, 10000):
        folder = Path(wanted if number == 1 else f'{wanted}-{number}')
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
    raise TapError(f'{wanted}: thousands of folders of that name; remove some')
