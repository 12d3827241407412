# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run methods on scenes, a result file for each task and method."""

from dataclasses import asdict, dataclass, replace
from datetime import date
from functools import lru_cache
import json
import os
from pathlib import Path
import platform
import time

from experiments.planning.episode import run_episode
from experiments.planning.methods import Method, STACKING_TASKS
from experiments.planning.stacking import stack
import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task
from sim_bridge.world.looks import DEFAULT_LOOK
from tap_ros.base.contract import GOAL_TOLERANCE, step_budget
from tap_ros.base.engines import LOCAL, run_tasks, Work
from tap_ros.base.errors import ConfigError, ImageError, PlanningError
from tap_ros.base.files import write_atomically
from tap_ros.base.plugins import load_plugin
from tap_ros.base.progress import Progress
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.weights import FORWARD_MODEL
from tap_ros.weights.weights import stored_digest
import torch

SPEED_ONLY = ('batch_size', 'threads')  # settings of the planner that change no result
DIGITS = 16  # of the SHA-256 of what a weights file holds
_digest, _simulator = lru_cache(stored_digest), lru_cache(Simulator)
_predictor, _learned = lru_cache(SubgoalPredictor.load), lru_cache(LearnedForwardModel.load)


@dataclass(frozen=True)
class Job:
    """A method on a task, ready to be run on any scene."""

    task: str
    method: Method
    planner: VisualMPCConfig = VisualMPCConfig()
    forward_weights: str = str(FORWARD_MODEL)
    predictor: str = ''  # weights file; '' when nothing is predicted
    device: str = 'cpu'
    preset: str = ''  # name of the planner's settings
    command: str = ''  # that makes the numbers again
    look: str = DEFAULT_LOOK  # of the world

    @property
    def stacks(self):
        """Whether pictures are brought about by picking up and placing, not by pushing."""
        return self.task in STACKING_TASKS

    @property
    def file_name(self):
        """Return the name, without suffix, of its files in the folder of all results."""
        folder = 'stacking' if self.stacks else 'planning'
        return f'{folder}/{self.task}-{self.method.file_name}'

    def steps(self):
        """Return the step budget."""
        return self.method.step_budget or step_budget(get_task(self.task).num_objects)

    @property
    def about(self):
        """Return as a dict what is stored beside the settings and changes no result."""
        return {'command': self.command, 'date': date.today().isoformat(),
                'machine': f'{platform.machine()}, {os.cpu_count()} CPUs',
                'version': f'torch {torch.__version__}'}

    def settings(self):
        """Return as a dict all that changes results; weights by what is in them."""
        settings = {
            'task': self.task, 'look': self.look, 'method': self.method.name,
            'device': self.device,
            'predictor_weights': _digest(self.predictor)[:DIGITS] if self.predictor else None}
        if self.stacks:
            return settings | {'object_places': 'ground_truth'}
        planner = asdict(self.method.planner(self.planner))
        if planner['solver'] == 'cem':  # results of before there were others do not tell
            del planner['solver']
        precision = next(_learned(self.forward_weights, self.device).push.parameters()).dtype
        return json.loads(json.dumps(settings | {
            'step_budget': self.steps(), 'reached_px': GOAL_TOLERANCE,
            'object_pixels': self.method.tracking,
            'planner': {k: v for k, v in planner.items() if k not in SPEED_ONLY},
            'preset': self.preset, 'precision': str(precision),
            'forward_weights': _digest(self.forward_weights)[:DIGITS]}))


class ResultFile:
    """What one job found in the scenes so far; ConfigError if it was made with other settings."""

    def __init__(self, folder, job):
        self.path = Path(folder, job.file_name + '.json')
        self.settings, self.scenes, self._about = job.settings(), {}, job.about
        if self.path.exists():
            stored, self.scenes = read_results(self.path)
            changed = [k for k in self.settings if stored.get(k) != self.settings[k]]
            if changed:
                raise ConfigError(
                    f'{self.path}: was made with other settings ({", ".join(changed)}); name '
                    'another folder with --out, or remove the file')

    def add(self, scene):
        """Keep the result of one scene, a dict with its seed; the file is replaced at once."""
        self.scenes[scene['seed']] = scene
        lines = [json.dumps(self.scenes[seed]) for seed in sorted(self.scenes)]
        text = json.dumps(self.settings | self._about) + ',\n"scenes": [\n ' + ',\n '.join(lines)
        write_atomically(self.path, '{"settings": ' + text + '\n]}\n')


def read_results(path):
    """
    Return the settings of a result file, and its scenes by seed; ConfigError if damaged.

    Settings of the planner that no longer exist are left out: each had but the one value that now
    is a constant. Where no look is told, there was but one.
    """
    try:
        stored = json.loads(Path(path).read_text())
        scenes = {scene['seed']: scene for scene in stored['scenes']}
        for scene in scenes.values():
            float(scene['final_cm']), list(scene['objects_cm']), int(scene['steps'])
        settings = dict(stored['settings'])
        if 'planner' in settings:
            settings['planner'] = known(settings['planner'], asdict(VisualMPCConfig()))
        return settings, scenes
    except (AttributeError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f'{path}: is damaged ({type(error).__name__}: {error}); remove it and '
                          'its scenes are run again') from error


def known(stored, names):
    """Return a dict without what is not in another one, likewise the dicts in it."""
    return {name: known(value, names[name]) if isinstance(value, dict) else value
            for name, value in stored.items() if name in names}


def load_results(folder):
    """Read all result files of a folder: (task, method name) -> (settings, scenes by seed)."""
    found = {}
    for path in sorted(Path(folder).glob('*.json')):
        settings, scenes = read_results(path)
        if scenes:
            found[settings['task'], settings['method']] = settings, scenes
    return found


def run_jobs(jobs, seeds, folder, engine=LOCAL, progress=True):
    """Run all Jobs on the scenes of seeds that are not done; return a ResultFile for each."""
    files = [ResultFile(folder, job) for job in jobs]
    # scene by scene, so that what was run so far can be compared
    todo = [(i, seed) for seed in seeds for i, file in enumerate(files)
            if seed not in file.scenes]
    tasks = {Work(f'{jobs[i].task}, {jobs[i].method.name}, scene {seed}', run_scene,
                  (jobs[i], seed)): i for i, seed in todo}
    with Progress(total=len(todo), desc='scenes x methods', disable=not progress) as bar:
        for task, get in run_tasks(tasks, engine):
            i, scene = tasks[task], get()
            files[i].add(scene)
            bar.set_postfix_str(f'{jobs[i].method.name} {scene["final_cm"]:.1f} cm')
            bar.update()
    return files


def run_scene(job, seed):
    """
    Run a job on one scene.

    :return: dict of seed, final_cm (mean over objects), objects_cm and steps; of pushing also
        switches, blocked (descents that met something at one place, at most), plan_ms (median)
        and, without true object pixels, tracking_error_px and why nothing was planned (refused),
        or no more (aborted), if so; of stacking success, first_right, moves and seconds.
    """
    begin = time.perf_counter()
    try:
        run = make_episode(job, seed)
    except (ImageError, PlanningError) as error:
        raise PlanningError(f'{job.task}, {job.method.name}, scene {seed}: {error}') from error
    centimetres = 100 * (run.distances if job.stacks else run.distances[-1])
    scene = {'seed': int(seed), 'final_cm': round(float(centimetres.mean()), 3),
             'objects_cm': centimetres.round(3).tolist(), 'steps': len(run.frames) - 1}
    if job.stacks:
        return scene | {'success': run.success, 'first_right': run.first_right,
                        'moves': len(run.moves), 'seconds': round(time.perf_counter() - begin, 2)}
    scene['switches'] = [int(step) for step in run.switches]
    scene['blocked'] = run.blocked()
    scene['plan_ms'] = (round(float(np.median(run.planning_ms)), 1) if len(run.planning_ms)
                        else None)
    if job.method.tracking != 'ground_truth':
        if not run.refused:
            scene['tracking_error_px'] = round(run.tracking_error(), 3)
        scene |= {name: why for name in ('placed', 'refused', 'aborted')
                  if (why := getattr(run, name))}
    return scene


def make_episode(job, seed):
    """Run a job on one scene; return the PlannedEpisode or StackedEpisode."""
    torch.set_num_threads(1)  # with more, the predictor's last digits differ
    simulator = _simulator(job.task, 64, job.look)
    predictor = _predictor(job.predictor, job.device) if job.predictor else None
    if job.stacks:
        return stack(simulator, job.method, seed, predictor)
    model = _learned(job.forward_weights, job.device)
    if job.method.model != 'learned':
        model = load_plugin('tap_ros.forward_models', job.method.model).load(
            job.forward_weights, job.device, simulator)
    mpc = VisualMPC(model, replace(job.method.planner(job.planner), threads=1))
    return run_episode(simulator, mpc, job.method, job.steps(), seed, predictor)
