# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `python -m experiments worlds-loop`: a closed loop that another world judges.

Bags of pushes in another world, a forward model and predictors from them, and the loop of the
nodes, planning/reach.py, in fresh scenes. What counts is the environment's own signal.
"""

from dataclasses import dataclass
from itertools import pairwise
import json
import os
from pathlib import Path

import cv2
from experiments.pages import markdown, render, share
from experiments.planning.methods import FIRST_SCENE
from experiments.worlds.judged import (
    BUDGETS,
    draw_strip,
    film,
    IMAGE_SIZE,
    PLANNED,
    run_scene,
    SUBGOALS,
    UNTRAINED,
    Weights,
    WITH_WAYS,
)
import numpy as np
import pandas as pd
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.metaworld import WAYS
from tap_ros.apps.train import train
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.options import Flag, Folder
from tap_ros.base.progress import Progress
from tap_ros.evaluation.intervals import mean_interval, share_interval
from tap_ros.images.drawing import grid
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks

BAGS = {'random': 100_000, 'goal': 0}  # of pushes; the first seed
METHODS = (*UNTRAINED, *PLANNED)
FILMED = ('subgoal', 'places')  # the first that is there beside direct
LEARNED = ('fixed time', 'subgoal')  # with a predictor of their own
REPEATED = ('direct', *LEARNED)  # by the networks of each seed; others by those of the first one
RESULTS = Path(__file__).resolve().parents[2] / 'docs' / 'results'
MARKED, MOVED = 12, 1.0  # demonstrations; px, beyond which an object has begun to move
AT, RESTS, JOLT = 0.06, 0.005, 0.025  # m: by the way; in a period of rest; as the hand leaves
# At the usual learning rate it came to believe that nothing ever moves.
FORWARD = {'robot_mask': 'arm', 'initial_weights': 'push', 'batch_size': 8, 'grow': 0.3,
           'learning_rate': 5e-4, 'device': 'cpu', 'threads': 1, 'save_every': 100,
           'split': 'crc32'}
# The robot is taken out of all pictures: what is planned to are places of objects.
PREDICTOR = {'progress_margin': 0.0, 'start_crop': 0.0, 'initial_weights': 'push2', 'margin': 1,
             'colour': False, 'brightness': 0.0, 'goal_picture': 'recorded', 'robot_mask': 'all',
             'fill_context': 1.0, 'batch_size': 8, 'device': 'cpu', 'threads': 1,
             'save_every': 250}
# Beside the wall the object is far from where start and goal show it: keyframes have it.
COPIED = {'selection': 'marks', 'keyframes': True, 'new_pixels': False, 'initial_weights': '',
          'fill_context': 0.5}


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: in which objects slide on a table in view of the camera: of Meta-World, such as
        push-v3 and plate-slide-v3, where nothing is in the way, or world/task.
    :param episodes: of each bag: demonstrations, and pushes at random.
    :param steps: of the training of each forward model.
    :param predictor_steps: of the training of each predictor.
    :param methods: that act in each scene.
    :param seeds: trainings of a forward model and of each predictor; places and retrieval plan
        with the first forward model.
    :param scenes: of each task; those are left out whose goal the script of the environment's
        authors does not bring about.
    :param bags: folder of the bags; what was collected is kept, what was interrupted goes on.
    :param runs: folder of the trainings and of the scenes that were run, which are not run again;
        other settings need another one.
    :param out: folder for worlds_loop.json, .md and .png; of OGBench worlds_loop_ogbench.json.
    :param results_only: run no more scenes.
    """

    tasks: tuple[str, ...] = ('push-wall-v3',)
    episodes: int = 120
    steps: int = 3000
    predictor_steps: int = 1500
    methods: tuple[str, ...] = METHODS
    seeds: int = 1
    scenes: int = 50
    bags: Folder = 'bags/loop'
    runs: Folder = 'runs/loop'
    out: Folder = 'runs/results'
    results_only: Flag = False
    engine: Engine = Engine()


def run(args):
    """Run what needs no training, collect, train, run the rest; the page is written all along."""
    unknown = set(args.methods) - set(METHODS)
    if unknown:
        raise ConfigError(f'methods: {", ".join(sorted(unknown))} unknown; valid: '
                          + ', '.join(METHODS))
    for task in () if args.results_only else args.tasks:
        Path(args.runs, task).mkdir(parents=True, exist_ok=True)
        run_scenes(args, task, {method: Weights() for method in UNTRAINED})
        for seed in range(args.seeds):
            run_scenes(args, task, make_weights(args, task, seed), seed)
    write_results(Path(args.runs), Path(args.out), args)
    draw(args)
    print(*(Path(args.out, f'{page}.md') for page in by_page(args.tasks)))


def draw(args):
    """Draw the scenes that are kept; film the first where one of FILMED succeeds, direct fails."""
    for page, tasks in by_page(args.tasks).items():
        strips, films = [], []
        for task in tasks:
            folder, (_, done) = Path(args.runs, task), read_rows(args.runs, task)
            strips += filter(None, (draw_strip(task, seed, folder) for seed in done))
            films += [(task, seed, folder, ('direct', method)) for method in FILMED
                      for seed, rows in done.items() if {'direct', method} <= rows.keys()
                      and rows[method] and rows[method]['ends'] and not rows['direct']['ends']]
        if strips:
            cv2.imwrite(str(Path(args.out, f'{page}.png')), grid(strips)[..., ::-1])
        if shown := next(filter(None, (film(*one) for one in films)), None):
            write_atomically(Path(args.out, f'{page}.webp'), shown)


def make_weights(args, task, seed):
    """Make bags and trainings of a task; return Weights by method."""
    bag, runs, ways = Path(args.bags, task), Path(args.runs, task), WAYS.get(task, ())
    world, _, name = task.rpartition('/')
    planned = [method for method in args.methods
               if method in PLANNED and (seed == 0 or method in REPEATED)]
    if not planned:
        return {}
    for pushes, first in BAGS.items():
        collect(bag / pushes, CollectConfig(
            world=world or 'metaworld', task=name, pushes=pushes, episodes=args.episodes,
            seed=first, image_size=IMAGE_SIZE, episodes_per_file=10), args.engine)
    forward = str(train([bag / pushes for pushes in BAGS], runs / f'forward_{seed}', 'forward',
                        steps=args.steps, seed=seed, **FORWARD))
    marks = str(mark(bag / 'goal', ways))
    weights = {method: Weights(forward, '', f'{bag / "goal"}{os.pathsep}{marks}')
               for method in planned}
    how = {'fixed time': {'loss': 'fix'}, 'subgoal': {'selection': 'marks', 'marks': marks}}
    if ways:
        timed = str(mark_times(bag / 'goal', len(ways)))
        how = {method: {**COPIED, 'marks': path, 'recursion': len(ways)}
               for method, path in (('fixed time', timed), ('subgoal', marks))}
    for method, settings in how.items():
        if method in weights:
            weights[method] = weights[method]._replace(predictor=str(train(
                bag / 'goal', runs / f'{method.replace(" ", "_")}_{seed}',
                steps=args.predictor_steps, seed=seed, **{**PREDICTOR, **settings})))
    return weights


def mark(folder, ways=()):
    """
    Mark a dozen demonstrations, off by at most a frame: where the object comes to rest by the way.

    :param ways: places (2,) m. Without any, the marks of several objects are where each but the
        last has come to rest at its goal, the mark of one is where the hand is at it.
    """
    store, rng, marks = open_recordings([folder]), np.random.default_rng(0), {}
    for i in range(len(store)):
        episode = store[i]
        if episode.outcome != 'success':
            continue
        places, last = episode.object_poses[..., :2], len(ways) or len(episode.object_names) - 1
        stations = [(0, way) for way in ways] or list(enumerate(episode.goal_poses[:, :2]))
        if last:
            at = [_arrival(places[:, k], station) for k, station in stations]
            at = at if ways or None in at else sorted(at)[:last]
        else:
            pixels = episode.object_pixels[:, 0]
            at = [int((np.linalg.norm(pixels - pixels[0], axis=1) > MOVED).argmax()) - 1]
        if None not in at and at == sorted({*at}):
            marks[i] = [(t, t) for t in np.clip(
                at + rng.integers(0 if last else -1, 2, len(at)), 1, len(episode) - 2).tolist()]
        if len(marks) == MARKED:
            break
    path = Path(folder, 'marks.json')
    write_marks(path, store, [folder], marks)
    return path


def mark_times(folder, count):
    """Mark all demonstrations at equal shares of their time, of one half way; return the file."""
    store = open_recordings([folder])
    path = Path(folder, 'times.json')
    write_marks(path, store, [folder], {
        i: [(int(length) * n // (count + 1),) * 2 for n in range(1, count + 1)]
        for i, length in enumerate(store.lengths)})
    return path


def _arrival(places, way):
    """Return the frame in which an object comes to where it rests longest; None without a rest."""
    rests = np.linalg.norm(np.diff(places, axis=0), axis=1) < RESTS
    there = np.flatnonzero(rests & (np.linalg.norm(places[:-1] - way, axis=1) < AT))
    if not len(there):
        return None
    longest = max(np.split(there, np.flatnonzero(np.diff(there) > 1) + 1), key=len)
    away = np.linalg.norm(places[:longest[0]] - places[longest[-1]], axis=1) > JOLT
    return int(np.flatnonzero(away).max(initial=-1)) + 1


def run_scenes(args, task, weights, training=0):
    """Run methods in the scenes that have a goal; what was run is not run again."""
    path, done = read_rows(args.runs, task)
    chosen = [method for method in args.methods if method in weights
              and (task in SUBGOALS or method not in WITH_WAYS)]
    seed, count = FIRST_SCENE, 0
    with Progress(total=args.scenes, unit='scene', desc=f'{task}: {", ".join(chosen)}') as bar:
        while chosen and count < args.scenes:
            rows = done.setdefault(seed, {})
            for method in chosen:
                name = method + f' {training}' * (training > 0)
                if name not in rows and None not in rows.values():
                    found = run_scene(task, method, seed, weights[method], Path(args.runs, task))
                    rows[name] = found and {**found, 'training': training}
                    write_atomically(path, json.dumps(done) + '\n')
            solved = None not in rows.values()
            count, seed = count + solved, seed + 1
            bar.update(solved)
            write_results(Path(args.runs), Path(args.out), args)


def read_rows(runs, task):
    """Return the file of a task's scenes, and its rows by seed and method; None: no goal."""
    path = Path(runs, task, 'scenes.json')
    found = json.loads(path.read_text()) if path.exists() else {}
    return path, {int(seed): rows for seed, rows in found.items()}


def by_page(tasks):
    """Return tasks by the name of their world's page."""
    found = {}
    for task in tasks:
        world = task.rpartition('/')[0]
        found.setdefault('worlds_loop' + f'_{world}' * bool(world), []).append(task)
    return found


def write_results(runs, out, args):
    """Write all rows and the table of each world, as far as scenes were run."""
    for page, tasks in by_page(args.tasks).items():
        rows = [row for task in tasks for rows in read_rows(runs, task)[1].values()
                for row in rows.values() if row]
        if not rows:
            continue
        write_rows(out / f'{page}.json', rows)
        values = {'table': summarise(rows), 'marked': MARKED, 'episodes': args.episodes,
                  'steps': args.steps, 'predictor_steps': args.predictor_steps,
                  'start': f'{np.mean([row["start_cm"] for row in rows]):.1f}',
                  'budget': BUDGETS['push-wall-v3'], 'scenes': args.scenes, 'seeds': args.seeds,
                  # What is said of these runs alone is not said of others.
                  'ours': out.resolve() == RESULTS,
                  'legs': last_legs([row for row in rows if row['task'] in SUBGOALS]),
                  'dropped': {method: dropped(rows, method) for method in LEARNED},
                  'by_training': {method: by_training(rows, method) for method in REPEATED},
                  'more': ahead([row for row in rows if row['task'] in WAYS])}
        template = f'worlds/templates/{page}.md.j2'
        known = Path(__file__).parents[1].joinpath(template).exists()
        write_atomically(out / f'{page}.md', render(template, **values) if known
                         else markdown(values['table'], 2) + '\n')


def ahead(rows):
    """Say by how many points the subgoal is ahead of the others that plan, in the same scenes."""
    if not any(row['method'] == 'subgoal' for row in rows):
        return {}
    ends, found = pd.DataFrame(rows).pivot_table(
        'ends', ['task', 'seed'], 'method', lambda those: those.mean()), {}
    for other in [method for method in PLANNED[:-1] if method in ends]:
        both = 100 * ends[['subgoal', other]].dropna().astype(float)
        if len(both):
            found[other] = '{:+.0f} points ({:+.0f} to {:+.0f})'.format(
                *mean_interval((both['subgoal'] - both[other]).tolist()))
    return found


def by_training(rows, method):
    """Say how often each training of a method succeeds, if there are several."""
    found = {}
    for row in rows:
        if row['method'] == method:
            found.setdefault(row['training'], []).append(row['ends'])
    return ', '.join(f'{np.mean(found[one]):.0%}' for one in sorted(found)) if len(
        found) > 1 else ''


def dropped(rows, method):
    """
    Say in how many runs of a method a subgoal is passed before any command goes to it.

    It is reached already: where the objects are, or undecided, see hierarchy.Target.
    """
    there = [[row['ends'] for row in rows if row['method'] == method and said == any(
        before == now for before, now in pairwise([0, *row['switches']]))]
        for said in (True, False)]
    return '{2} of {4} ({0} succeed, of the others {1} of {3})'.format(
        *map(sum, there), *map(len, there), sum(map(len, there)))


def last_legs(rows):
    """Say how many failures of the subgoal came after its last one; nothing where none failed."""
    failed = [row for row in rows if row['method'] == 'subgoal' and not row['ends']]
    passed = sum(len(row['switches']) == SUBGOALS[row['task']] for row in failed)
    return f'{passed} of {len(failed)} failures' if failed else ''


def summarise(rows):
    """Return a line for each task and method: shares and distances with 95% intervals."""
    found = []
    rows = sorted(rows, key=lambda row: METHODS.index(row['method']))
    for (task, method), same in pd.DataFrame(rows).groupby(['task', 'method'], sort=False):
        scenes = same.groupby('seed', sort=False)
        line = {'task': task.rpartition('/')[2], 'method': method, 'scenes': scenes.ngroups,
                'trainings': same['training'].nunique() if method in REPEATED else None}
        mean = scenes['ends'].mean()
        line['success'] = share(share_interval(mean.tolist()) if set(mean) <= {0, 1}
                                else mean_interval(mean.tolist()))
        value, low, high = mean_interval(scenes['final_cm'].mean().tolist())
        line['end, cm'] = f'{value:.1f} ({low:.1f} to {high:.1f})'
        found.append({**line, 'commands': f'{np.mean(same["steps"]):.0f}'})
    return pd.DataFrame(found).astype({'trainings': 'Int64'})
