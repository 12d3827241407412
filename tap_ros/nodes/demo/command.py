# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The demo: real nodes in processes of their own push objects to where a goal picture shows them.

Each scene is pushed twice: directly, and via the subgoal that predict_subgoal answers. Everything
goes through the topics, services and actions that any client would use. Where a gripper is needed
the subgoal is predicted only; nothing here plans grasps.
"""

from dataclasses import dataclass
from functools import partial
import os
from pathlib import Path
import platform
import shlex
import shutil
import subprocess
import sys
import time
from typing import Annotated, Any

from action_msgs.msg import GoalStatus
import numpy as np
import rclpy
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.expert import run_episode
from sim_bridge.tasks.tasks import get_task, TASKS
from sim_bridge.world.looks import DEFAULT_LOOK, LOOKS, OBSERVER
from tap_msgs.action import ReachGoal
from tap_msgs.msg import ObjectStates, Subgoal
from tap_msgs.srv import PredictSubgoal, ResetScene
from tap_ros.contract import step_budget
from tap_ros.errors import ConfigError, TapError
from tap_ros.nodes.clients import call, send_goal, Spinner, wait_for_result
from tap_ros.nodes.demo.film import write_film
from tap_ros.nodes.demo.report import (
    results_table,
    Run,
    SceneRuns,
    write_overview,
    write_report,
)
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.image_messages import decode_image, decode_map
from tap_ros.nodes.node_processes import NodeProcesses
from tap_ros.nodes.observations import Observations
from tap_ros.nodes.topics import LATCHED, SERVICE_QOS, STREAM, to_nanoseconds
from tap_ros.options import Flag, Folder, one_of
from tap_ros.planning.scenes import FIRST_SCENE
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS
from tqdm import tqdm
from tyro import conf

USUAL_TASKS = ('push2', 'order2', 'stack2')
BUDGETS = f'{step_budget(2)} and {step_budget(3)}'  # of two and of three objects
MODES = ('direct', 'subgoal')
START_TIMEOUT_S = 90.0
CALL_TIMEOUT_S = 20.0
STEP_TIMEOUT_S = 15.0  # of one step of a run, far more than planning takes


class Watch:
    """
    Keep every camera picture of a scene, the objects in it, and what else is shown for people.

    :param node: rclpy Node that another thread spins.
    """

    def __init__(self, node: Node) -> None:
        self._kept: dict[str, dict[int, Any]] = {}
        self._topics = {'image': (Image, 'camera/image_raw'), 'objects': (ObjectStates, 'objects'),
                        'side': (Image, 'observer/image_raw'),
                        'plan': (Image, 'plan/overlay')}
        for topic, (message_type, name) in self._topics.items():
            node.create_subscription(message_type, name, partial(self._keep, topic), STREAM)
        self.begin()

    def begin(self) -> None:
        """Forget what was seen."""
        self.first_ns = 0  # what is stamped before this is of another scene
        self._kept = {topic: {} for topic in self._topics}

    def seen(self) -> tuple[list[Image], list[ObjectStates]]:
        """Return the images and the objects that belong to them, in order of their stamps."""
        images, objects = dict(self._kept['image']), dict(self._kept['objects'])
        stamps = self._in_order(set(images) & set(objects))
        return [images[stamp] for stamp in stamps], [objects[stamp] for stamp in stamps]

    def shown(self, topic: str) -> list[Image]:
        """Return the pictures from the 'side' or of each 'plan', in order of their stamps."""
        pictures = dict(self._kept[topic])
        return [pictures[stamp] for stamp in self._in_order(set(pictures))]

    def _in_order(self, stamps: set[int]) -> list[int]:
        return sorted(stamp for stamp in stamps if stamp >= self.first_ns)

    def _keep(self, topic: str, message: Any) -> None:
        self._kept[topic][to_nanoseconds(message.header.stamp)] = message


class DemoClient:
    """
    The demo's own node: it resets the scene, asks for a subgoal and for pushes, and watches.

    :param processes: NodeProcesses to keep an eye on.
    :param task: what is done; where it is pushing, there is a planner to be waited for.
    """

    def __init__(self, processes: NodeProcesses, task: str) -> None:
        self.node = rclpy.create_node(f'demo_{task}')
        self._processes = processes
        self._reset = self.node.create_client(ResetScene, 'sim/reset')
        self._predict = self.node.create_client(
            PredictSubgoal, 'predict_subgoal', qos_profile=SERVICE_QOS)
        self._reach = ActionClient(self.node, ReachGoal, 'reach_goal')
        self._plans = not get_task(task).gripping
        self._alive = {name: Liveness(self.node, name) for name in (
            'sim_node', 'predictor_node', 'visual_mpc_node')}
        self._camera = Watch(self.node)
        self._goal = Observations('image', 'objects', latched=True)
        self._goal.subscribe(self.node, {
            'image': (Image, 'goal/image'), 'objects': (ObjectStates, 'goal/objects')}, LATCHED)

    def wait_until_ready(self) -> None:
        """Wait until every node offers what it offers only when it is ready."""
        deadline = time.monotonic() + START_TIMEOUT_S
        waiting = {
            'sim_node': self._reset.service_is_ready,
            'predictor_node': self._predict.service_is_ready}
        if self._plans:
            waiting['visual_mpc_node'] = self._reach.server_is_ready
        while waiting:
            self._processes.check()
            for name in [name for name, ready in waiting.items() if ready()]:
                print(f'  {name} is ready', flush=True)
                del waiting[name]
            if time.monotonic() > deadline:
                raise TapError(
                    f'{", ".join(waiting)} not ready after {START_TIMEOUT_S:g} s; see the logs')
            time.sleep(0.1)
        # That of the first scene, which is kept for late joiners: the next one is another.
        self._goal.wait(('image', 'objects'), CALL_TIMEOUT_S)

    def reset(self, task: str, seed: int) -> dict[str, Any]:
        """Start a scene; return its goal as a dict of image and objects."""
        before = self._goal.newest('image', 'objects')
        after_ns = -1 if before is None else to_nanoseconds(before['image'].header.stamp)
        self._camera.begin()
        answer = call(self._reset, ResetScene.Request(task=task, seed=seed), CALL_TIMEOUT_S,
                      server=self._alive['sim_node'])
        if not answer.success:
            raise TapError(f'sim/reset: {answer.message}')
        goal = self._goal.wait(('image', 'objects'), CALL_TIMEOUT_S, after_ns)
        if goal is not None:  # of the same stamp as the first picture of the scene
            self._camera.first_ns = to_nanoseconds(goal['image'].header.stamp)
        deadline = time.monotonic() + CALL_TIMEOUT_S
        while goal is not None and not self._camera.seen()[0] and time.monotonic() < deadline:
            time.sleep(0.01)
        if goal is None or not self._camera.seen()[0]:
            raise TapError(f'no camera or goal picture came within {CALL_TIMEOUT_S:g} s')
        return goal

    def start(self) -> tuple[Image, ObjectStates]:
        """Return the first picture of the scene and the objects in it."""
        images, objects = self._camera.seen()
        return images[0], objects[0]

    def predict(self) -> Subgoal:
        """Ask for a subgoal as a person would by hand: with an empty request."""
        deadline = time.monotonic() + CALL_TIMEOUT_S
        while True:
            answer = call(self._predict, PredictSubgoal.Request(), CALL_TIMEOUT_S,
                          server=self._alive['predictor_node'])
            if answer.success and answer.subgoals[0].object_maps:
                return answer.subgoals[0]
            # Right after the start the predictor may not have heard of the simulator yet.
            if time.monotonic() > deadline:
                raise TapError(f'predict_subgoal: {answer.message}')
            time.sleep(0.2)

    def push(self, mode: str, seed: int, step_budget: int, goal: dict[str, Any]) -> Run:
        """
        Have the arm push until the goal is reached or the budget spent.

        :return: Run.
        """
        planning_ms = []
        with tqdm(total=step_budget, desc=f'    {mode:<8}', unit='step', leave=False) as bar:
            def on_feedback(feedback: Any) -> None:
                planning_ms.append(feedback.planning_ms)
                bar.set_postfix_str(
                    f'to the {feedback.stage}, {feedback.expected_distance:.1f} px expected')
                bar.update(feedback.step - bar.n)
            request = ReachGoal.Goal(mode=mode, step_budget=step_budget, seed=seed)
            planner = self._alive['visual_mpc_node']
            handle = send_goal(self._reach, request, CALL_TIMEOUT_S, on_feedback, planner)
            status, result = wait_for_result(
                handle, CALL_TIMEOUT_S + STEP_TIMEOUT_S * step_budget, planner)
        if status != GoalStatus.STATUS_SUCCEEDED:
            raise TapError(f'reach_goal ({mode}): {result.message}')
        self._processes.check()
        images, objects = self._camera.seen()
        goals = positions(goal['objects'])
        return Run(
            frames=[decode_image(image, 'camera/image_raw') for image in images],
            distances=np.array([np.linalg.norm(positions(o) - goals, axis=1) for o in objects]),
            message=result.message, planning_ms=float(np.median(planning_ms or [np.nan])),
            side=[decode_image(image, 'observer/image_raw')
                  for image in self._camera.shown('side')],
            plans=[decode_image(image, 'plan/overlay') for image in self._camera.shown('plan')])


def positions(message: ObjectStates) -> np.ndarray:
    """Return (K, 3) metres of a tap_msgs/ObjectStates."""
    points = [state.pose.position for state in message.objects]
    return np.array([(p.x, p.y, p.z) for p in points])


def pixels(message: ObjectStates) -> np.ndarray:
    """Return (K, 2) (u, v) of a tap_msgs/ObjectStates."""
    return np.array([(state.u, state.v) for state in message.objects])


def run_scene(client: DemoClient, task: str, seed: int, step_budget: int,
              look: str) -> SceneRuns:
    """
    Predict a subgoal of one scene; push it in every mode, or show how the expert does it.

    :param step_budget: the most steps of a run.
    :param look: of the world.
    :return: SceneRuns.
    """
    runs: dict[str, Run] = {}
    goal = client.reset(task, seed)
    subgoal, (image, objects) = client.predict(), client.start()
    for mode in () if get_task(task).gripping else MODES:
        if runs:
            goal = client.reset(task, seed)
        begin = time.monotonic()
        runs[mode] = client.push(mode, seed, step_budget, goal)
        run = runs[mode]
        print(f'    {mode:<8} {100 * run.distances[0].mean():5.1f} -> '
              f'{100 * run.distances[-1].mean():5.1f} cm in {len(run.frames) - 1} steps, '
              f'{time.monotonic() - begin:.0f} s ({run.planning_ms:.0f} ms a plan)', flush=True)
    return SceneRuns(
        task=task, seed=seed, start=decode_image(image, 'camera/image_raw'),
        goal=decode_image(goal['image'], 'goal/image'), start_pixels=pixels(objects),
        goal_pixels=pixels(goal['objects']), subgoal=decode_image(subgoal.image, 'subgoal'),
        object_maps=np.stack([decode_map(m, 'object_maps') for m in subgoal.object_maps]),
        runs=runs, side_goal_pixels=OBSERVER.project(positions(goal['objects'])),
        expert=() if runs else film_expert(task, seed, look))


def film_expert(task: str, seed: int, look: str) -> list[np.ndarray]:
    """Return pictures from the side of the expert doing a task, without ROS."""
    simulator = Simulator(task, look=look)
    try:
        _, actions, _, _ = run_episode(simulator, seed)
        simulator.reset(seed)
        pictures = [simulator.observer_picture()]
        for action in actions:
            simulator.step(action)
            pictures.append(simulator.observer_picture())
        return pictures
    finally:
        simulator.close()


def start_nodes(processes: NodeProcesses, folder: Path, task: str, look: str) -> None:
    """Start simulator, predictor, recorder and, for tasks that push, the planner."""
    processes.start('recorder_node', folder=folder / 'recording' / task)
    processes.start('sim_node', lock_step=True, task=task, look=look, observer=True)
    processes.start('predictor_node', weights=task if task in PREDICTORS else DEFAULT_PREDICTOR)
    if not get_task(task).gripping:
        processes.start('visual_mpc_node')


@dataclass(frozen=True)
class Options:
    """
    Options of the demo.

    :param scenes: how many of each task.
    :param seed: of the first scene of each task.
    :param tasks: what is to be done in them; none named: push2, order2 and stack2, or with attach
        push2.
    :param look: of the world, see sim_node.
    :param out: folder for the page, the recording and the logs; a number is added when it exists.
    :param attach: use nodes that run already, for example those of demo.launch.py.
    """

    scenes: int = 2
    seed: int = FIRST_SCENE
    tasks: tuple[Annotated[str, one_of(TASKS)], ...] = ()
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
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
    if len(set(tasks)) < len(tasks):
        raise ConfigError(f'tasks: {" ".join(tasks)}: name each once')
    folder = new_folder(args.out)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    begin = time.monotonic()
    try:
        scenes = [scene for task in tasks for scene in run_task(args, task, folder)]
    finally:
        rclpy.try_shutdown()
    seconds = time.monotonic() - begin
    pushed = [scene for scene in scenes if scene.runs]
    write_overview(folder / 'subgoals.png', scenes)
    write_report(
        folder / 'report.html', scenes,
        f'Tasks {", ".join(tasks)}, seeds {args.seed} to {args.seed + args.scenes - 1} of each, '
        f'at most {_budget(args, tasks[0])} steps of a push, {seconds:.0f} s in all. Object '
        'pixels at every step, and the distances, are ground truth of the simulator.',
        _facts())
    if pushed:
        write_film(folder / 'demo.webp', pushed)
        print(f'\n{results_table(pushed)}\n')
        print(f'film       {folder / "demo.webp"}')
    if not args.attach:
        print(f'recording  {folder / "recording"}')
    print(f'page       {folder / "report.html"}')
    return 0


def _facts() -> dict[str, str]:
    """Say what makes a page: when, of which commit, by which command, on what machine."""
    found = subprocess.run(  # outside of a checkout git says nothing
        ['git', '-C', str(Path(__file__).parent), 'log', '-1', '--format=%h'],
        capture_output=True, text=True, check=False) if shutil.which('git') else None
    commit = found.stdout.strip() if found is not None else ''
    return {'date': time.strftime('%Y-%m-%d %H:%M'), 'commit': commit or 'unknown',
            'command': shlex.join(['python', '-m', 'tap_ros', *sys.argv[1:]]),
            'machine': f'{platform.machine()}, {os.cpu_count()} CPUs'}


def run_task(args: Options, task: str, folder: Path) -> list[SceneRuns]:
    """Run the scenes of one task with nodes of its own, or with those that run already."""
    client = None
    try:
        with NodeProcesses(folder / 'logs' / task) as processes:
            client = DemoClient(processes, task)
            with Spinner(client.node):
                if args.attach:
                    print(f'{task}: waiting for the nodes that run already', flush=True)
                else:
                    print(f'{task}: starting nodes; their logs are in {folder / "logs" / task}',
                          flush=True)
                    start_nodes(processes, folder, task, args.look)
                client.wait_until_ready()
                scenes = []
                for i in range(args.scenes):
                    print(f'  scene {args.seed + i} ({i + 1} of {args.scenes})', flush=True)
                    scenes.append(run_scene(
                        client, task, args.seed + i, _budget(args, task), args.look))
                return scenes
    finally:
        if client is not None:
            client.node.destroy_node()


def _budget(args: Options, task: str) -> int:
    """Return the most steps of one run."""
    return args.step_budget or step_budget(get_task(task).num_objects)


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
