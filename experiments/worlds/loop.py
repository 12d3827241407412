# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `python -m experiments worlds-loop`: a closed loop that another world judges.

Bags of pushes in Meta-World, a forward model and predictors from them, and the loop of the nodes,
planning/reach.py, in fresh scenes. What counts is the environment's own signal.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
import json
from pathlib import Path

import cv2
from experiments.pages import render, share
from experiments.planning.episode import run_episode
from experiments.planning.methods import FIRST_SCENE, Method
from experiments.worlds.pushes import push_to_goal, WORLDS
import numpy as np
import pandas as pd
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.metaworld import MetaWorld
from tap_ros.apps.train import train
from tap_ros.base.contract import ACTION_LIMIT, step_budget
from tap_ros.base.engines import Engine
from tap_ros.base.errors import SceneError
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.options import Flag, Folder
from tap_ros.evaluation.intervals import mean_interval, share_interval
from tap_ros.images.drawing import enlarge, grid
from tap_ros.planning.mpc_config import VisualMPCConfig
from tap_ros.planning.protocols import SearchConfig
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tqdm import tqdm

WORLD, IMAGE_SIZE = 'metaworld', 64
BAGS = {'random': 100_000, 'goal': 0}  # of pushes; the first seed
METHODS = ('random', 'straight', 'direct', 'subgoal')
MARKED, MOVED = 12, 1.0  # demonstrations; px, beyond which an object has begun to move
FORWARD = {'robot_mask': 'arm', 'initial_weights': 'push', 'batch_size': 8, 'grow': 0.3,
           'device': 'cpu', 'threads': 1, 'save_every': 200, 'split': 'crc32'}
PREDICTOR = {'selection': 'marks', 'progress_margin': 0.0, 'start_crop': 0.0,
             'initial_weights': 'push2', 'goal_picture': 'recorded', 'robot_mask': 'arm',
             'fill_context': 1.0, 'batch_size': 8, 'device': 'cpu', 'threads': 1}
# Half of what is usual, so that a plan takes half the time.
PLANNER = VisualMPCConfig(SearchConfig(32, 2, 4), proposals=16, recheck=0, threads=1)
REACHED = 2.0  # px, here about cm: within this, the object is at its goal
STRIPS = 3  # scenes of each task that are drawn
SCALE = 2  # of pictures that are drawn
_planner, _predictor = lru_cache(VisualMPC.load), lru_cache(SubgoalPredictor.load)


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: of Meta-World, in which an object slides on the table in view of the camera.
    :param episodes: of each bag: pushes at random, and demonstrations.
    :param steps: of the training of the forward model, on the bags of all tasks.
    :param predictor_steps: of the training of each task's predictor.
    :param methods: that act in each scene.
    :param scenes: of each task; those are left out whose goal the script of the environment's
        authors does not bring about.
    :param bags: folder of the bags; what was collected is kept, what was interrupted goes on.
    :param runs: folder of the trainings and of the scenes that were run.
    :param out: folder for worlds_loop.json, worlds_loop.md and worlds_loop.png.
    :param results_only: run no more scenes.
    """

    tasks: tuple[str, ...] = ('push-v3', 'plate-slide-v3')
    episodes: int = 60
    steps: int = 800
    predictor_steps: int = 400
    methods: tuple[str, ...] = METHODS
    scenes: int = 50
    bags: Folder = 'bags/loop'
    runs: Folder = 'runs/loop'
    out: Folder = 'runs/results'
    results_only: Flag = False
    engine: Engine = Engine()


def run(args):
    """Collect, train, run scene by scene all methods, write what came of it."""
    if not args.results_only:
        run_scenes(args, make_weights(args))
    write_results(Path(args.runs), Path(args.out), args)


def make_weights(args):
    """Make bags and trainings; return paths by task, and the forward model's."""
    bags = {task: Path(args.bags, task) for task in args.tasks}
    for task, folder in bags.items():
        for pushes, seed in BAGS.items():
            collect(folder / pushes, CollectConfig(
                world=f'{WORLD} {pushes}', task=task, episodes=args.episodes, seed=seed,
                image_size=IMAGE_SIZE, episodes_per_file=10), args.engine, make=WORLDS[pushes])
    weights = {'forward': str(train(
        [folder / name for folder in bags.values() for name in BAGS],
        Path(args.runs, 'forward'), 'forward', steps=args.steps, **FORWARD))}
    for task, folder in bags.items():
        weights[task] = '' if 'subgoal' not in args.methods else str(train(
            folder / 'goal', Path(args.runs, task), steps=args.predictor_steps,
            marks=mark(folder / 'goal'), **PREDICTOR))
    return weights


def mark(folder):
    """Mark a dozen demonstrations where the hand is at the object, off by at most a frame."""
    store, rng, marks = open_recordings([folder]), np.random.default_rng(0), {}
    for i in range(len(store)):
        episode = store[i]
        places = episode.object_pixels[:, 0]
        way = np.linalg.norm(places - places[0], axis=1)
        if len(marks) < MARKED and episode.outcome == 'success':
            t = int((way > MOVED).argmax()) - 1 + int(rng.integers(-1, 2))
            t = int(np.clip(t, 1, len(way) - 2))
            marks[i] = [(t, t)]
    path = Path(folder, 'marks.json')
    write_marks(path, store, [folder], marks)
    return path


def run_scenes(args, weights):
    """Run the methods in the scenes that have a goal; what was run is not run again."""
    with tqdm(total=args.scenes * len(args.tasks), unit='scene') as bar:
        for task in args.tasks:
            (path, done), seed, count = read_rows(args.runs, task), FIRST_SCENE, 0
            while count < args.scenes:
                rows = done.setdefault(seed, {})
                for method in args.methods:
                    if method not in rows:
                        rows[method] = run_scene(
                            task, method, seed, weights['forward'], weights[task], args.runs)
                        write_atomically(path, json.dumps(done) + '\n')
                solved = all(rows.values())
                count, seed = count + solved, seed + 1
                bar.update(solved)


def read_rows(runs, task):
    """Return the file of a task's scenes, and its rows by seed and method; None: no goal."""
    path = Path(runs, task, 'scenes.json')
    found = json.loads(path.read_text()) if path.exists() else {}
    return path, {int(seed): rows for seed, rows in found.items()}


class Judged(MetaWorld):
    """Meta-World, and what it says after every step."""

    def reset(self, seed):
        """Begin a scene."""
        self.said = []
        return super().reset(seed)

    def step(self, action):
        """Act, and note."""
        seen = super().step(action)
        self.said.append(self.succeeds())
        return seen


_world = lru_cache(Judged)


def run_scene(task, method, seed, forward, predictor, runs):
    """Run a method in a scene; return what came of it, None if the scene has no goal."""
    world = _world(task, IMAGE_SIZE)
    try:
        pictures = act(world, method, seed, _planner(forward, PLANNER), predictor)
    except SceneError:
        return None
    start = pictures.pop()
    if method == 'subgoal' and seed < FIRST_SCENE + STRIPS:
        cv2.imwrite(str(Path(runs, task, f'strip_{seed}.png')), grid([pictures])[..., ::-1])
    goal = world.goal().object_poses[0, :3] - world.goal_places()[0]
    return {'task': task, 'method': method, 'seed': seed, 'ends': bool(world.succeeds()),
            'ever': any(world.said), 'steps': len(world.said),
            'goal_cm': round(100 * float(np.linalg.norm(goal)), 2), 'start_cm': start,
            'final_cm': round(100 * float(world.distances()[0]), 2)}


def act(world, method, seed, mpc, predictor):
    """Act as long as a goal may take; return pictures of start, subgoals, end and goal, cm."""
    budget = step_budget(1)
    if method in ('direct', 'subgoal'):
        predict = _predictor(predictor) if method == 'subgoal' else None
        ran = run_episode(world, mpc, Method(method), budget, seed, predict, REACHED)
        frames, distance = ran.frames, ran.distances[0, 0]
        shown = [frames[0], *(subgoal.image for subgoal in ran.subgoals), frames[-1]]
    else:
        first = world.reset(seed)
        distance, rng = world.distances()[0], np.random.default_rng(seed)
        actions = push_to_goal(world) if method == 'straight' else (
            np.append(rng.uniform(-1, 1, 3) * ACTION_LIMIT, 0) for _ in range(budget))
        last = first
        for _, action in zip(range(budget), actions):
            last = world.step(action)
        shown = [first.image, last.image]
    return [*(enlarge(image, SCALE) for image in (*shown, world.goal().image)),
            round(100 * float(distance), 2)]


def write_results(runs, out, args):
    """Write all rows, the table and the strips."""
    rows = [row for task in args.tasks for rows in read_rows(runs, task)[1].values()
            for row in rows.values() if row]
    write_rows(out / 'worlds_loop.json', rows)
    strips = [[cv2.imread(str(path))] for task in args.tasks
              for path in sorted(Path(runs, task).glob('strip_*.png'))]
    if strips:
        cv2.imwrite(str(out / 'worlds_loop.png'), grid(strips))
    write_atomically(out / 'worlds_loop.md', render(
        'worlds/templates/worlds_loop.md.j2', table=pd.DataFrame(summarise(rows)), marked=MARKED,
        **asdict(args)))
    print(out / 'worlds_loop.md')


def summarise(rows):
    """Return a line for each task and method: shares and distances with 95% intervals."""
    found = []
    for (task, method), same in pd.DataFrame(rows).groupby(['task', 'method'], sort=False):
        line = {'task': task, 'method': method, 'scenes': len(same)}
        for name in ('ends', 'ever'):
            line[name] = share(share_interval(same[name].tolist()))
        for name in ('start_cm', 'final_cm'):
            value, low, high = mean_interval(same[name].tolist())
            line[name] = f'{value:.1f} ({low:.1f} to {high:.1f})'
        found.append({**line, 'steps': f'{np.mean(same["steps"]):.0f}'})
    return found
