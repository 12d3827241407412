# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `python -m experiments worlds`: who finds the bottleneck in demonstrations of others.

Demonstrations of other simulators, keyframes of them, and predictors trained on them.
"""

from dataclasses import dataclass
import json
from pathlib import Path
import re
from typing import Literal, NamedTuple

import cv2
from experiments.pages import render
from experiments.worlds.ogbench import OGBench
from experiments.worlds.trained import (
    CUTS,
    held_out_of,
    mark,
    MARKED,
    METHODS,
    place_marks,
    SETTINGS,
    train_all,
    WITH_MARKS,
)
import numpy as np
import pandas as pd
from sim_bridge.collect import BOTTLENECKS_FILE, collect, CollectConfig
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.options import Flag, Folder
from tap_ros.evaluation.intervals import bootstrap, Interval, mean_interval, share_interval
from tap_ros.images.drawing import grid
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks
from tap_ros.recording.reading import Reading
from tap_ros.training.labels import film, fit, moments_of
from tap_ros.training.marks import chance

Method = Literal['fix', 'over time', 'relative', 'progress', 'still', 'marks', 'keyframes']
TASKS = ('metaworld/coffee-push-v3', 'metaworld/door-open-v3', 'metaworld/peg-insert-side-v3',
         'metaworld/window-open-v3', 'metaworld/drawer-open-v3',
         'metaworld/button-press-topdown-v3', 'ogbench/button', 'ogbench/cube', 'ogbench/drawer',
         'ogbench/window')
# Tasks, and seeds of the first demonstration of two of the above, that no choice was made by.
ASIDE = {**{f'metaworld/{task}-v3': 0 for task in (
    'hammer', 'door-lock', 'drawer-close', 'handle-press', 'faucet-open', 'dial-turn',
    'plate-slide')}, 'metaworld/button-press-topdown-v3': 5000, 'ogbench/drawer': 5000,
    'ogbench/puzzle': 0}
IMAGE_SIZE = 128  # px, as recorded
FOUND = 0.75, 0.85  # of the demonstrations, exactly or within a frame: a task counts as found
KINDS = 'own', 'aside', 'without'  # tasks by TASKS; kept aside; trained without marks


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: world/task each.
    :param episodes: demonstrations of each task to train on.
    :param held_out: others, to score.
    :param seed: of the first demonstration.
    :param methods: that are trained on each task, beside keyframes, which need no training.
    :param seeds: trainings of each method.
    :param bags: folder of the bags; what was collected is kept, what was interrupted goes on.
    :param runs: folder of the trainings.
    :param out: folder for worlds.json, worlds.md and worlds.png.
    :param results_only: collect nothing.
    """

    tasks: tuple[str, ...] = TASKS
    episodes: int = 50
    held_out: int = 40
    seed: int = 0
    methods: tuple[Method, ...] = tuple(METHODS)
    seeds: int = 3
    bags: Folder = 'bags/worlds'
    runs: Folder = 'runs/worlds'
    out: Folder = 'runs/results'
    results_only: Flag = False
    engine: Engine = Engine()


def run(args):
    """Collect, draw strips of the bottlenecks, score keyframes and trainings, write the page."""
    rows, strips = score_tasks(dict.fromkeys(args.tasks, args.seed), args.methods, args)
    if args.tasks == TASKS:
        more = score_tasks(ASIDE, [one for one in args.methods if one in WITH_MARKS], args,
                           'aside/')
        rows, strips = rows + more[0], strips + more[1]
    out = Path(args.out)
    if args.tasks == TASKS:  # one table
        rows = merged(out / 'worlds.json', rows)
    write_rows(out / 'worlds.json', rows)
    write_atomically(out / 'worlds.md', page(rows))
    cv2.imwrite(str(out / 'worlds.png'), grid(strips)[..., ::-1])
    print(out / 'worlds.md')


def merged(file, rows):
    """Return the rows of a file, if it is there, with new ones in place of those they repeat."""
    old = json.loads(file.read_text()) if file.exists() else []
    return list({(row['task'], row['method']): row for row in [*old, *rows]}.values())


def score_tasks(tasks, methods, args, prefix=''):
    """
    Collect demonstrations, score keyframes of them and trainings on them; print each score.

    :param tasks: by their names seeds of their first demonstrations.
    :param prefix: of the tasks' names in the results, and of their folders.
    :return: list of rows of both kinds, and of each task a strip.
    """
    rows, folders, strips = [], {}, []
    for name, first_seed in tasks.items():
        world, _, task = name.partition('/')
        folders[prefix + name] = folder = Path(args.bags, prefix, world, task)
        if not args.results_only:
            for bag, episodes, seed in (
                    (folder, args.episodes, first_seed),
                    (held_out_of(folder), args.held_out, first_seed + 10 ** 6)):
                collect(bag, CollectConfig(
                    world=world, task=task, episodes=episodes, seed=seed,
                    image_size=IMAGE_SIZE, episodes_per_file=10), args.engine,
                    make=OGBench if world == 'ogbench' else None)
        training, held_out = (read(bag, CUTS.get(name, ''))
                              for bag in (folder, held_out_of(folder)))
        one, (first, last) = held_out[0].frames, held_out[0].window
        strips.append([one[i] for i in (0, first, (first + last) // 2, last, -1)])
        for seed in range(args.seeds):
            mark(folder, training, seed)
        # Of keyframes all are held out that no seed marks.
        scored = score([place_marks(folder, training, seed) for seed in range(args.seeds)],
                       training[MARKED * args.seeds:] + held_out)
        rows += [{'task': prefix + name, **row} for row in scored]
        print(f'{prefix}{name}, in the bottleneck, within a frame:', ', '.join(
            f"{row['method']} {row['hit']['value']:.0%}, {row['near']['value']:.0%}"
            for row in scored), flush=True)
    return rows + average(
        train_all(folders, methods, args.seeds, args.runs, args.engine)), strips


class Demonstration(NamedTuple):
    """A demonstration whose bottleneck is known."""

    frames: np.ndarray  # (T, H, W, 3) uint8
    window: tuple[int, int]  # first and last frame of the bottleneck
    stamps: np.ndarray  # (T,) s
    number: int = 0  # in its bag


def read(folder, crop=''):
    """Read a bag, cut as --crop says, as Demonstrations; ConfigError without bottlenecks."""
    path = Path(folder, BOTTLENECKS_FILE)
    if not path.exists():
        raise ConfigError(f'{path}: is not there; collect it by a world that knows bottlenecks')
    store = open_recordings([folder], reading=Reading(crop=crop, size=SETTINGS['size']))
    truth = read_marks(path, store).episodes
    return [Demonstration(store[i].frames, truth[i][0], store[i].stamps / 1e9, i)
            for i in sorted(truth)]


def score(marked, held_out):
    """
    Score keyframes.

    :param marked: of each seed, the Demonstrations that are marked, and the frames.
    :return: list of dicts: method, hit and near (at most a frame beside the bottleneck), each
        with value, low and high, n, and the mean frames of bottlenecks and demonstrations.
    """
    from experiments.worlds import keyframes
    guesses = {name: [[choose(one.frames) for one in held_out]] for name, choose in (
        ('middle', keyframes.middle), ('slowest', keyframes.slowest), ('UVD-like', keyframes.uvd))}
    guesses[f'{MARKED} marks'] = [label(demonstrations, frames, held_out)
                                  for demonstrations, frames in marked]
    length = float(np.mean([last - first + 1 for _, (first, last), *_ in held_out]))
    rows = []
    for name, draws in {'random': [], **guesses}.items():
        found = {'hit': 0, 'near': 1}
        for key, beside in found.items():
            found[key] = _interval([
                [first - beside <= frame <= last + beside
                 for frame, (_, (first, last), *_) in zip(frames, held_out)] for frames in draws
            ]) if draws else mean_interval([
                chance(window, len(frames), beside) for frames, window, *_ in held_out])
        rows.append({'method': name, 'n': len(held_out), 'bottleneck_frames': length,
                     'frames': float(np.mean([len(one.frames) for one in held_out])),
                     **{key: Interval(*map(float, value))._asdict()
                        for key, value in found.items()}})
    return rows


def label(marked, frames, others):
    """Return the frames that labels by marks name in other Demonstrations."""
    model, _ = fit(list(map(_film, marked)), [
        one.stamps[[t]] - one.stamps[0] for one, t in zip(marked, frames)])
    found = []
    for one in others:
        shown = _film(one)
        moment = moments_of(shown, model.log_posterior(shown))[0][0]
        found.append(int(np.abs(one.stamps - one.stamps[0] - moment).argmin()))
    return found


def _film(one):
    return film(one.frames, np.rint(one.stamps * 1e9).astype(np.int64))


def _interval(hits):
    """Return the share of hits (S, N) of S seeds, with the interval over the demonstrations."""
    return share_interval(hits[0]) if len(hits) == 1 else mean_interval(np.mean(hits, axis=0))


def average(rows):
    """Average over the seeds of each task and method, with intervals over the episodes."""
    found = {}
    for row in rows:
        found.setdefault((row['task'], row['method']), []).append(row)
    return [{'task': task, 'method': method, 'n': len(same[0]['hit']), 'seeds': len(same), **{
        key: Interval(*map(float, value))._asdict() for key, value in {
            **{name: _interval([row[name] for row in same]) for name in ('hit', 'near')},
            'error': bootstrap(
                lambda error, copying: error.mean((0, -1)) / copying.mean((0, -1)),
                *(np.array([row[name] for row in same]) for name in ('error', 'copying')))
        }.items()}} for (task, method), same in found.items()]


def page(rows):
    """Write the page of the results, a line for each task."""
    tables, found = ({kind: {} for kind in KINDS} for _ in range(2))
    for row in rows:
        task, method, hit, near = (row[name] for name in ('task', 'method', 'hit', 'near'))
        kind = ('aside' if task.startswith('aside/') else 'own' if 'seeds' not in row
                or method in WITH_MARKS else 'without')
        line = tables[kind].setdefault(task, {
            'task': re.sub('^(aside/)?(metaworld/)?', '', task).replace('/', ' ')})
        line[method] = f"{hit['value']:.0%}, {near['value']:.0%}" + (
            f"; {row['error']['value']:.2f}" if 'error' in row else '')
        found[kind].setdefault(method, []).append(
            any(value['value'] >= least for value, least in zip((hit, near), FOUND)))
    for kind, lines in tables.items():
        lines['found'] = {'task': '**found**'} | {
            method: f'**{sum(tasks)} of {len(tasks)}**' for method, tasks in found[kind].items()}
    lines = {kind: pd.DataFrame(list(lines.values())).drop(
        columns=['middle', 'random'], errors='ignore') for kind, lines in tables.items()}
    said = {}  # ranges over the tasks
    for name, form, value in (('frames', '{:.0f}', lambda row: row['frames']),
                              ('lasting', '{:.1f}', lambda row: row['bottleneck_frames']),
                              ('chance', '{:.0%}', lambda row: row['near']['value'])):
        values = [value(row) for row in rows if row['method'] == 'random']
        said[name] = f'{form} to {form}'.format(min(values), max(values))
    return render('worlds/templates/worlds.md.j2', marked=MARKED, cuts=CUTS, found=found,
                  more=compare(rows) if found['aside'] else {}, **said, **lines)


def compare(rows):
    """
    Compare predictors with and without keyframes, over the tasks with several trainings of both.

    :return: dict: tasks, how many; hit and near, in words the mean difference in points with its
        interval over the tasks, whose demonstrations and marks both had; error, the mean ratio of
        errors; alone, by hit and near those of the tasks that differ by themselves. There
        intervals are by Newcombe's square-and-add, as if the two had not seen the same
        demonstrations.
    """
    without, shown = ({row['task']: row for row in rows
                   if row['method'] == method and row.get('seeds', 0) > 1}
                  for method in WITH_MARKS)
    tasks = [task for task in shown if task in without]
    if not tasks:
        return {}
    found, alone = {'tasks': len(tasks)}, {}
    for name in ('hit', 'near'):
        gains = [_less(shown[task][name], without[task][name]) for task in tasks]
        found[name] = _in_points(mean_interval([gain.value for gain in gains]))
        alone[name] = [f'{task.rpartition("/")[2]} {_in_points(gain)}'
                  for task, gain in zip(tasks, gains) if gain.low > 0 or gain.high < 0]
    ratios = [shown[task]['error']['value'] / without[task]['error']['value'] for task in tasks]
    found['error'] = '{:.2f} ({:.2f} to {:.2f})'.format(*mean_interval(ratios))
    return found | {'alone': alone}


def _less(one, other):
    value = one['value'] - other['value']
    return Interval(value, value - np.hypot(one['value'] - one['low'],
                                            other['high'] - other['value']),
                    value + np.hypot(one['high'] - one['value'], other['value'] - other['low']))


def _in_points(gain):
    value, low, high = (f'{round(100 * each):+d}' for each in gain)
    return f'{value} ({low} to {high})'
