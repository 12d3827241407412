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

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
import os
from pathlib import Path
import platform
import shlex
import sys
import time
from typing import Annotated, Literal

from sim_bridge.collect import TABLE
from sim_bridge.tasks.tasks import get_task, task_names
from sim_bridge.world.looks import DEFAULT_LOOK, LOOKS
from tap_ros.apps.demo.film import film, Scene
from tap_ros.apps.demo.lane import run_scenes
from tap_ros.apps.demo.report import (
    as_row,
    gains,
    MODES,
    results_table,
    shown,
    summary,
    write_report,
)
from tap_ros.apps.node_processes import errors_in
from tap_ros.base.contract import ROBOT_MASKS, step_budget
from tap_ros.base.errors import ConfigError, TapError
from tap_ros.base.files import free_folder, write_rows
from tap_ros.base.options import Folder, one_of
from tap_ros.base.plugins import names
from tap_ros.robots.arm import DEFAULT_ARM
from tyro import conf

FIRST_SCENE = 2_000_000  # seeds from here on are in no recording, no training and no table
USUAL_TASKS = ('order2', 'order3')
OTHERS_OBJECTS = 1  # of tasks of other worlds
BUDGETS = f'{step_budget(2)} and {step_budget(3)}'  # of two and of three objects
TOLD = {  # by whether objects are tracked
    True: 'Objects are tracked from a click on each in the first picture (here its true pixel) '
          'and found in the goal picture; the ground truth of the simulator only measures '
          'distances and draws numbers and arrows.',
    False: 'Object pixels at every step, and the distances, are ground truth of the simulator.'}
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
    :param look: of the world, see sim_node.
    :param arm: at the table, see sim_node.
    :param out: folder for the page, the recording and the logs; a number is added when it exists.
    """

    scenes: int = 8
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
                for i in range(max(1, self.scenes // max(1, self.num_objects(task) - 1)))]

    def num_objects(self, task: str) -> int:
        """Return how many objects are pushed."""
        return get_task(task).num_objects if self.world == TABLE else OTHERS_OBJECTS

    def check(self) -> None:
        """Raise ConfigError for what cannot be run."""
        if self.scenes < 1 or self.step_budget < 0:
            raise ConfigError('scenes must be at least 1, and step-budget 0 or more')
        if self.world != TABLE and not self.tasks:
            raise ConfigError(f'world {self.world}: name its tasks, as --tasks push-v3')
        if len(set(self.tasks)) < len(self.tasks):
            raise ConfigError(f'tasks: {" ".join(self.tasks)}: name each once')
        pushing = [task for task in task_names() if get_task(task).kind == 'push']
        for task in self.tasks if self.world == TABLE else ():
            if task not in pushing:
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
    folder = new_folder(args.out)
    print(f'starting nodes; their logs are in {folder / "logs"}', flush=True)
    begin, scenes, left_out = time.monotonic(), list[Scene](), dict[str, str]()
    drawn, films = dict[str, Future[bytes]](), dict[str, bytes]()

    def write_page() -> None:
        write_rows(folder / 'scenes.json', map(as_row, scenes))
        reasons = '; '.join(f'{name}: {why}' for name, why in left_out.items()) or 'none'
        write_report(
            folder / 'report.html', scenes, films,
            f'{len(scenes)} of {len(args.plan)} scenes, from seed {args.seed} on, which are in no '
            f'recording, training or table. Left out, as they could not be finished: {reasons}. '
            f'{TOLD[args.tracked]} {REPEATS}', {
                'date': time.strftime('%Y-%m-%d %H:%M'),
                'time': f'{time.monotonic() - begin:.0f} s',
                'command': shlex.join(['python', '-m', 'tap_ros', *sys.argv[1:]]),
                'machine': f'{platform.machine()}, {os.cpu_count()} CPUs'})

    with ThreadPoolExecutor(1) as pool:
        for (task, seed), scene in zip(args.plan, run_scenes(args, folder, drawn)):
            if isinstance(scene, TapError):
                left_out[f'{task} {seed}'] = str(scene).splitlines()[0]
                print(f'  {task} {seed}   left out: {scene}', flush=True)
                continue
            scenes.append(scene)
            if task not in drawn and gains(scene):
                drawn[task] = pool.submit(film, scene)
            print(f'  {task} {seed}   ' + '   '.join(
                f'{name} {run.final_cm:5.1f} cm in {len(run.distances) - 1} steps'
                for mode, name in MODES.items() for run in [scene.runs[mode]]), flush=True)
            write_page()  # whatever ends the demo, what was done is there
    wrong = [f'{log}: {line}' for log in sorted((folder / 'logs').rglob('*.log'))
             for line in errors_in(log.read_text(errors='replace'))]
    for line in wrong[:MOST_SHOWN]:
        print(line)
    if scenes:
        for caption, scene in shown(scenes).items():
            films[caption] = drawn[scene.task].result() if scene.task in drawn else film(scene)
            (folder / f'{scene.task}.webp').write_bytes(films[caption])
            print(f'film       {folder / scene.task}.webp')
        write_page()
        print(f'\n{results_table(summary(scenes))}\n')
        print(f'recording  {folder / "recording"}')
        print(f'page       {folder / "report.html"}')
    print(f'time       {time.monotonic() - begin:.0f} s')
    print(f'scenes     {len(scenes)} finished, {len(left_out)} left out; '
          f'{len(wrong)} tracebacks and errors in the logs of the nodes')
    if not scenes:
        raise TapError(f'no scene could be finished; {left_out.popitem()[1]}')
    return int(bool(wrong))


def new_folder(wanted: str | Path) -> Path:
    """Make a folder of this name, or with the next free number behind it."""
    folder = free_folder(wanted)
    folder.mkdir(parents=True, exist_ok=True)
    return folder
