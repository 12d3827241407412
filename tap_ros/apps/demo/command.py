# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The demo: real nodes in processes of their own push objects to where a goal picture shows them.

Each scene is pushed twice, directly and via the subgoal that predict_subgoal answers, by two sets
of nodes side by side. Everything goes through the topics, services and actions that any client
would use, in lock-step: the same seeds end the same, however busy the machine is.

The objects are tracked: a click on each in the first picture, here at its true pixel, and another
in the goal picture on what is not found there. Ground truth only measures, and draws for people.
"""

from collections.abc import Container, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, replace
import os
from pathlib import Path
import platform
import shlex
import sys
import time
from typing import Annotated, Any, Literal

from rclpy.parameter import Parameter
from tap_ros.apps.demo.film import film, Scene
from tap_ros.apps.demo.report import (
    as_row,
    gains_clearly,
    MODES,
    results_table,
    shown,
    summary,
    write_report,
)
from tap_ros.apps.demo.watch import click, FOLLOWED_NO_MORE, Refused, right_order, Watch
from tap_ros.apps.node_processes import errors_in, NodeProcesses
from tap_ros.base.contract import (
    DEFAULT_LOOK,
    LOOKS,
    ROBOT_MASKS,
    step_budget,
    SUCCESS_DISTANCE,
    TABLE,
)
from tap_ros.base.errors import ConfigError, TapError
from tap_ros.base.files import free_folder, write_atomically, write_rows
from tap_ros.base.options import Folder, one_of
from tap_ros.base.plugins import load_plugin, names
from tap_ros.robots.arm import DEFAULT_ARM
from tap_ros.ros.client import Client
from tap_ros.ros.views import positions_of
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODELS, PREDICTORS
from tyro import conf

FIRST_SCENE = 2_000_000  # seeds from here on are in no recording, no training and no table
USUAL_TASKS = ('order2', 'order3')
BUDGETS = f'{step_budget(2)} and {step_budget(3)}'  # of two and of three objects
CALL_S, STEP_S = 60.0, 15.0  # that a call, and one step of a run, may take, far more than usual
LOOK_S = 1.0  # between two looks whether all nodes run
RESEND_S = 0.5  # sending pictures again takes time from plans
# In lock-step nothing moves while a node waits, so a busy machine changes nothing but the time.
PATIENT = {'image_timeout': 300.0, 'max_age': 300.0, 'max_silence': 60.0,
           'predictor_timeout': CALL_S}
SOURCES = {  # by whether objects are tracked
    True: 'Objects are tracked from a click on each in the first picture (here its true pixel) '
          'and found in the goal picture; one that is not found there is clicked there, too. For '
          'the rest the ground truth of the simulator only measures distances and draws numbers '
          'and arrows.',
    False: 'Object pixels at every step, and the distances, are ground truth of the simulator.'}
SUCCESS = (f'A scene succeeds if every object ends within {100 * SUCCESS_DISTANCE:.0f} cm of its '
           'goal.')
MOST_SHOWN = 10  # of the errors in logs
REPEATS = ('All runs are in lock-step: the same seeds end the same on a busy machine, only the '
           'seconds differ. Another processor can differ in the last digits of a plan.')


@dataclass(frozen=True)
class Options:
    """
    Options of the demo.

    :param scenes: how many of each task; half as many of three objects, which take twice as long.
    :param seed: of the first scene of each task; the others follow, none is left out.
    :param world: another world, such as metaworld with the task push-v3; its object is pushed by
        weights that were trained there.
    :param predictor: weights, shipped or a file; empty: those of the task.
    :param forward_model: weights of the planner.
    :param robot_mask: what is taken out of pictures, as it was in the training of the weights.
    :param objects: where they come from: tracked, from a click on each in the first picture, or
        truth, the simulator; so it is in another world.
    :param look: of the world: the whole arm at its table, or its hand alone.
    :param arm: at the table.
    :param out: folder for the page, the recording and the logs; a number is added when it exists.
    """

    scenes: int = 5
    seed: int = FIRST_SCENE
    tasks: Annotated[tuple[str, ...], conf.arg(
        help='what is to be done in them; none named: order2 and order3; of the table those that '
             'push.')] = ()
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

    @property
    def tracked(self) -> bool:
        """Whether objects are tracked."""
        return self.objects == 'tracked' and self.world == TABLE

    @property
    def plan(self) -> list[tuple[str, int]]:
        """Return the task and the seed of each scene."""
        return [(task, self.seed + i) for task in self.tasks or USUAL_TASKS
                for i in range(max(1, self.scenes // self.rounds(task)))]

    def num_objects(self, task: str) -> int:
        """Return how many objects are pushed."""
        return load_plugin('tap_ros.tasks', task).num_objects if self.world == TABLE else 1

    def rounds(self, task: str) -> int:
        """Return how often a subgoal is predicted: while more than one object is to be moved."""
        return max(1, self.num_objects(task) - 1)

    def weights(self, task: str) -> str:
        """Return the predictor's weights for a task."""
        return self.predictor or (task if task in PREDICTORS else DEFAULT_PREDICTOR)

    def check(self) -> None:
        """Raise ConfigError for what cannot be run."""
        if self.scenes < 1:
            raise ConfigError(f'scenes {self.scenes}: expected 1 or more')
        if self.step_budget < 0:
            raise ConfigError(f'step-budget {self.step_budget}: expected 0 or more')
        if self.world != TABLE and not self.tasks:
            raise ConfigError(f'world {self.world}: name its tasks, as --tasks push-v3')
        if len(set(self.tasks)) < len(self.tasks):
            raise ConfigError(f'tasks: {" ".join(self.tasks)}: name each once')
        pushing = [task for task in names('tap_ros.tasks')
                   if load_plugin('tap_ros.tasks', task).kind == 'push']
        for task in self.tasks if self.world == TABLE else ():
            if task not in pushing:
                load_plugin('tap_ros.tasks', task)  # else it is none, and what is meant is told
                raise ConfigError(f'task {task}: is not one of those that push, '
                                  f'{", ".join(pushing)}; see it with explore --task {task}')


def run(args: Options) -> int:
    """
    Run the demo and leave a recording, logs, films and a page, which grows with each scene.

    :param args: Options.
    :return: exit code, 1 where the logs of the nodes have errors.
    :raises TapError: when no scene could be finished.
    """
    args.check()
    used = {args.forward_model, *map(args.weights, args.tasks)}
    if args.world != TABLE and used & {*PREDICTORS, *FORWARD_MODELS}:
        print(f'warning: world {args.world}: the shipped weights know the table alone; give '
              '--predictor and --forward-model that were trained there', file=sys.stderr)
    folder = free_folder(args.out)
    print(f'starting nodes; their logs are in {folder / "logs"}', flush=True)
    begin, scenes, left_out = time.monotonic(), list[Scene](), dict[str, str]()
    filmed, films = set[str](), dict[str, bytes]()

    def write_page() -> None:
        write_rows(folder / 'scenes.json', map(as_row, scenes))
        reasons = '; '.join(f'{name}: {why}' for name, why in left_out.items()) or 'none'
        write_report(
            folder / 'report.html', scenes, films,
            f'{len(scenes)} of {len(args.plan)} scenes, from seed {args.seed} on, which are in no '
            f'recording, training or table. Left out, as they could not be finished: {reasons}. '
            f'{SUCCESS} {SOURCES[args.tracked]} {REPEATS}', {
                'date': time.strftime('%Y-%m-%d %H:%M'),
                'time': f'{time.monotonic() - begin:.0f} s',
                'command': shlex.join(['python', '-m', 'tap_ros', *sys.argv[1:]]),
                'machine': f'{platform.machine()}, {os.cpu_count()} CPUs'})

    for (task, seed), scene in zip(args.plan, run_scenes(args, folder, filmed)):
        if isinstance(scene, TapError):
            left_out[f'{task} {seed}'] = str(scene).splitlines()[0]
            print(f'  {task} {seed}   left out: {scene}', flush=True)
            continue
        scenes.append(scene)
        if gains_clearly(scene):
            filmed.add(task)
        print(f'  {task} {seed}   ' + '   '.join(
            f'{name} {run.final_cm:5.1f} cm in {len(run.distances) - 1} steps, '
            + ('success' if run.reached else 'failed')
            for mode, name in MODES.items() for run in [scene.runs[mode]]), flush=True)
        write_page()  # whatever ends the demo, what was done is there
    wrong = [f'{log}: {line}' for log in sorted((folder / 'logs').rglob('*.log'))
             for line in errors_in(log.read_text(errors='replace'))]
    for line in wrong[:MOST_SHOWN]:
        print(line)
    if scenes:
        for caption, scene in shown(scenes).items():
            films[caption] = film(scene)
            write_atomically(folder / f'{scene.task}.webp', films[caption])
            print(f'film       {folder / scene.task}.webp')
        write_page()
        print(f'\n{results_table(summary(scenes))}\n')
        print(f'{SUCCESS} Numbers of cm are means over objects.')
        print(f'recording  {folder / "recording"}')
        print(f'page       {folder / "report.html"}')
    print(f'time       {time.monotonic() - begin:.0f} s')
    print(f'scenes     {len(scenes)} finished, {len(left_out)} left out; '
          f'{len(wrong)} tracebacks and errors in the logs of the nodes')
    if not scenes:
        raise TapError(f'no scene could be finished; {left_out.popitem()[1]}')
    return int(bool(wrong))


def run_scenes(args: Options, folder: Path,
               filmed: Container[str]) -> Iterator[Scene | TapError]:
    """
    Run all scenes, both modes at the same time.

    :param folder: of the logs and the recording.
    :param filmed: tasks whose film will be of a scene before, so that no pictures are needed.
    :return: each scene, or why it could not be finished.
    :raises TapError: when the nodes cannot be started at all.
    """
    with ExitStack() as stack:
        sets = [NodeSet(args, folder, mode, filmed) for mode in MODES]
        for nodes in sets:
            stack.callback(nodes.close)
        start(sets, args.plan[0][0])
        for task, seed in args.plan:
            if sys.stdout.isatty():
                print(f'  {task} {seed} ...', end='\r', flush=True)
            yield run_scene(sets, task, seed)


def start(sets: Sequence['NodeSet'], task: str) -> None:
    """Have all nodes ready, of those that are not there."""
    for nodes in sets:
        nodes.start(task)
    for nodes in sets:
        nodes.processes.wait_until_ready()


def run_scene(sets: Sequence['NodeSet'], task: str, seed: int) -> Scene | TapError:
    """
    Push the objects of a scene, by each set of nodes at the same time.

    :return: the scene, or why it cannot be finished; then the next one begins with new nodes.
    """
    try:
        start(sets, task)
        with ThreadPoolExecutor() as pool:
            pushing = [pool.submit(nodes.push, task, seed) for nodes in sets]
            try:
                while wait(pushing, LOOK_S).not_done:
                    for nodes in sets:
                        nodes.processes.check()
            except BaseException:
                for nodes in sets:
                    nodes.processes.end()  # this ends what waits for them, too
                raise
        scenes = [push.result() for push in pushing]
        return replace(scenes[-1], runs={
            mode: run for scene in scenes for mode, run in scene.runs.items()})
    except TapError as error:
        if not isinstance(error, Refused):
            for nodes in sets:
                nodes.close()
        return error


class NodeSet:
    """
    Nodes that run scenes in one mode.

    :param mode: one of MODES; and the others: see run_scenes.
    """

    def __init__(self, args: Options, folder: Path, mode: str, filmed: Container[str]) -> None:
        self._args, self._folder, self._mode, self._filmed = args, folder, mode, filmed
        self._task = ''
        self._nodes: ExitStack | None = None  # with client and processes, while they are there

    def start(self, task: str) -> None:
        """Start the nodes and a client, unless they are there."""
        if self._nodes is not None:
            return
        args, table, subgoals = self._args, self._args.world == TABLE, self._mode == 'subgoal'
        namespace = '' if subgoals else f'/{self._mode}'
        world: dict[str, Any] = {'world': args.world} if not table else {
            'look': args.look, 'arm': args.arm, 'observer': True}
        if args.tracked:
            world['objects'] = 'tracked'
        self._nodes, self._task = ExitStack(), task
        self._client = self._nodes.enter_context(Client(namespace, CALL_S))
        self._watch = Watch(self._client, args.tracked,
                            'observer/image_raw' if table else 'camera/image_raw')
        self.processes = self._nodes.enter_context(NodeProcesses(
            free_folder(self._folder / 'logs' / self._mode), namespace))
        begin = self.processes.start
        if subgoals:
            begin('recorder_node', folder=free_folder(self._folder / 'recording'))
        begin('sim_node', lock_step=True, resend_period=RESEND_S, task=task, **world)
        if args.tracked:
            begin('tracker_node', patience=CALL_S)
        if subgoals:
            begin('predictor_node', robot_mask=args.robot_mask, weights=args.weights(task))
        begin('visual_mpc_node', weights=args.forward_model, robot_mask=args.robot_mask,
              arm=args.arm, preset='quick', subgoal_rounds=args.rounds(task), **PATIENT)

    def close(self) -> None:
        """End the nodes."""
        if self._nodes is not None:
            self._nodes.close()
            self._nodes = None

    def push(self, task: str, seed: int) -> Scene:
        """Start a scene and have the arm push until its goal is reached or the budget spent."""
        args, client, watch, mode = self._args, self._client, self._watch, self._mode
        if task != self._task:
            if mode == 'subgoal' and args.weights(task) != args.weights(self._task):
                client.use_weights(args.weights(task))
            client.call('set_planner', parameters=[
                Parameter('subgoal_rounds', value=args.rounds(task)).to_parameter_msg()])
            self._task = task
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
        feedback = list(reaching)
        result = reaching.result()
        # An object that cannot be followed any more is an end as good as any.
        if result.end != 'succeeded' and not (feedback and FOLLOWED_NO_MORE in result.message):
            raise TapError(f'reach_goal ({mode}): {result.message}')
        run = watch.run(start, goal, feedback, result)
        begun = positions_of(watch.at(watch.truth, start.stamp_ns))
        return Scene(task, seed, goal.image, start.pixels, goal.pixels,
                     right_order(begun, goal.positions), {mode: run})
