# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `python -m experiments few`: what a predictor learns from few demonstrations.

A curve over their number in a task of Meta-World, and real ones in folds: each demonstration is
scored by a predictor that has not seen it, nor was stopped by it.
"""

from dataclasses import dataclass
import json
from pathlib import Path

from experiments.pages import render, share
from experiments.paper.figures import COLOURS, INK, new_figure, to_png
from experiments.tables import said
from experiments.worlds.command import read
from experiments.worlds.trained import held_out_of, mark, MARKED, marks_of
import numpy as np
from sim_bridge.collect import BOTTLENECKS_FILE, collect, CollectConfig
from tap_ros.apps.train import train
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import Folder
from tap_ros.evaluation.intervals import against_copying, mean_interval
from tap_ros.evaluation.prediction import evaluate
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.bags import reading_like
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats import pictures
from tap_ros.recording.formats.pictures import natural
from tap_ros.recording.marks import read_marks
import torch

HELD_OUT = 40  # demonstrations in Meta-World
IN_A_FILE = 10
SETTINGS = {'recipe': 'push2', 'steps': 400, 'batch_size': 8, 'size': 64, 'threads': 1,
            'progress_margin': 0.0, 'save_every': 10 ** 6}
# What real demonstrations are trained with, beside SETTINGS; two pictures a second, of some
# minutes each.
REAL = {'selection': 'relative', 'rate': 2.0, 'num_targets': 30, 'patience': 150,
        'initial_weights': 'push2'}


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param real: folder of real demonstrations: a folder each, with a video of each camera; without
        it those that were scored before stay in the results.
    :param cameras: names of the videos, without ending, that are used.
    :param folds: in so many parts real demonstrations are held out, 3 at least.
    :param task: of Meta-World, for the curve.
    :param demonstrations: points of the curve.
    :param seeds: trainings of each point.
    :param bags: folder of the bags; what is there is kept.
    :param runs: folder of the trainings.
    :param out: folder for few.json, few.png and few.md.
    """

    real: Folder = ''
    cameras: tuple[str, ...] = ('0', '1')
    folds: int = 4
    task: str = 'drawer-open-v3'
    demonstrations: tuple[int, ...] = (10, 30, 100, 300)
    seeds: int = 1
    bags: Folder = 'bags/few'
    runs: Folder = 'runs/few'
    out: Folder = 'runs/results'


def run(args):
    """Train and score what is not there yet, and write the results."""
    torch.set_num_threads(1)
    file = Path(args.out, 'few.json')
    before = json.loads(file.read_text()) if file.exists() else {'real': []}
    found = {'task': args.task, 'curve': curve(args),
             'real': real(args) if args.real else before['real']}
    write(found, Path(args.out))
    print(Path(args.out, 'few.md'))


def write(found, folder):
    """Write few.json, few.png and few.md."""
    parts = ('[' + ',\n'.join(map(json.dumps, value)) + ']' if isinstance(value, list)
             else json.dumps(value) for value in found.values())
    write_atomically(folder / 'few.json', '{' + ',\n'.join(
        f'"{name}": {part}' for name, part in zip(found, parts)) + '}\n')
    write_atomically(folder / 'few.png', draw(found))
    write_atomically(folder / 'few.md', page(found))


def curve(args):
    """Return a dict for each number of demonstrations and seed: scores of every episode."""
    bag = Path(args.bags, args.task)
    for folder, episodes, seed in ((bag, max(args.demonstrations), 0),
                                   (held_out_of(bag), HELD_OUT, 10 ** 6)):
        collect(folder, CollectConfig(
            world='metaworld', task=args.task, episodes=episodes, seed=seed, image_size=128,
            episodes_per_file=IN_A_FILE), Engine())
    mark(bag, read(bag), 0)
    files = sorted(bag.glob('*.mcap'), key=natural)
    rows = []
    for seed in range(args.seeds):
        for count in args.demonstrations:
            weights = train(
                files[:count // IN_A_FILE], Path(args.runs, f'{args.task}_{count}_{seed}'),
                seed=seed, held_out=(str(held_out_of(bag)),), marks=str(marks_of(bag, 0)),
                selection='marks', start_crop=0.0, **SETTINGS)
            store, scores = score(weights, [held_out_of(bag)])
            truth = read_marks(held_out_of(bag) / BOTTLENECKS_FILE, store).episodes
            beside = [max(first - t, t - last, 0) for t, ((first, last), *_) in zip(
                scores.match_step, (truth[i] for i in sorted(truth)))]
            rows.append({'demonstrations': count, 'seed': seed, **errors(scores),
                         'beside': list(map(int, beside))})
    return rows


def real(args):
    """Return a dict for each demonstration: the mean scores of its cameras."""
    folders = sorted({file.parent for file in Path(args.real).rglob('*.mp4')
                      if file.stem in args.cameras}, key=natural)
    if len(folders) < args.folds:
        raise ConfigError(f'--real {args.real}: {len(folders)} folders with videos named '
                          f'{" or ".join(args.cameras)}, fewer than --folds {args.folds}')
    bags = [Path(args.bags, 'real', folder.name) for folder in folders]
    for folder, bag in zip(folders, bags):
        if not bag.exists():
            pictures.run(pictures.Options(
                paths=tuple(str(folder / f'{camera}.mp4') for camera in args.cameras),
                out=str(bag), crop='centre', size=SETTINGS['size']))
    rows = []
    for k in range(args.folds):
        # One part is scored, the next one says when to stop.
        scored, stopping = bags[k::args.folds], bags[(k + 1) % args.folds::args.folds]
        weights = train([bag for bag in bags if bag not in scored], Path(args.runs, f'real_{k}'),
                        held_out=tuple(map(str, stopping)), **SETTINGS | REAL)
        for bag in scored:
            means = {name: round(float(np.mean(values)), 5)
                     for name, values in errors(score(weights, [bag])[1]).items()}
            rows.append({'demonstration': bag.name, **means})
    return rows


def score(weights, bags):
    """Return the store of bags and the EpisodeScores of predictions of all their episodes."""
    network, training = load_network(weights)
    store = open_recordings(bags, reading=reading_like(training, bags))
    return store, evaluate(network, store, range(len(store)))['prediction']


def errors(scores):
    """Return the errors at the matched frame of each episode, of predictions and of copying."""
    return {'error': np.round(scores.min_l1.astype(float), 5).tolist(),
            'copying': np.round(scores.copying.astype(float), 5).tolist()}


def relative(rows):
    """Compare the error with that of copying, see against_copying; a row a seed or an episode."""
    found = [np.array([row[name] for row in rows]) for name in ('error', 'copying')]
    return against_copying(*(each.mean(0) if each.ndim == 2 else each for each in found))


def lines(found):
    """Return the lines of the list."""
    for count in dict.fromkeys(row['demonstrations'] for row in found['curve']):
        rows = [row for row in found['curve'] if row['demonstrations'] == count]
        beside = np.array([row['beside'] for row in rows])
        hit, near = (share(mean_interval((beside <= most).mean(0))) for most in (0, 1))
        yield _line(f'{count} simulated', rows, f', {hit}, {near}')
    if found['real']:
        yield _line(f'{len(found["real"])} real', found['real'])


def _line(which, rows, more=''):
    ratio = relative(rows)[1]
    return said(f'- {which}: ' + '{:.2f} ({:.2f} to {:.2f})'.format(*ratio) + more, ratio.high < 1)


def draw(found):
    """Draw the error, as a multiple of that of copying, over the number of demonstrations."""
    groups = {}
    for row in found['curve']:
        groups.setdefault(f'{row["demonstrations"]}\nsimulated', []).append(row)
    if found['real']:
        groups[f'{len(found["real"])}\nreal'] = found['real']
    ratios = np.array([relative(rows)[1] for rows in groups.values()])
    figure, ((axis,),) = new_figure(2.5, 1)
    axis.bar(range(len(groups)), ratios[:, 0], 0.6, color=COLOURS['ours'], capsize=3,
             yerr=np.abs(ratios[:, 1:] - ratios[:, :1]).T, error_kw={'ecolor': INK})
    axis.axhline(1, color=INK, linewidth=1)
    axis.annotate('copying an input', (len(groups) - 0.5, 1), ha='right', va='bottom',
                  fontsize=8, color=INK)
    axis.set_xticks(range(len(groups)), groups)
    axis.set_ylabel('error / copying', color=INK)
    return to_png(figure)


def page(found):
    """Write the page of the results."""
    real = {}
    if found['real']:
        rows = found['real']
        real = {'count': len(rows), 'won': sum(row['error'] < row['copying'] for row in rows)}
    return render('templates/few.md.j2', task=found['task'], marked=MARKED, held_out=HELD_OUT,
                  steps=SETTINGS['steps'], batch=SETTINGS['batch_size'],
                  seeds=1 + max(row['seed'] for row in found['curve']),
                  lines=lines(found), real=real)
