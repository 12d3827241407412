# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictors trained on the demonstrations of a foreign task, and which frames they match."""

from contextlib import redirect_stderr
import json
from pathlib import Path

import numpy as np
from tap_ros.base.engines import run_tasks, Work
from tap_ros.base.files import write_atomically
from tap_ros.base.progress import Progress

MARKED = 10  # demonstrations of each task, others in each training
# A name in tables: settings beside those that all have.
METHODS = {
    'fix': {'loss': 'fix', 'steps': 400},
    'over time': {'selection': 'absolute', 'steps': 400},
    'relative': {'steps': 400},
    'progress': {'selection': 'progress', 'progress_margin': 0.5, 'steps': 400},
    'still': {'selection': 'still', 'steps': 400},
    'marks': {'selection': 'marks'},
    'keyframes': {'selection': 'marks', 'keyframes': True, 'new_pixels': False},
}
WITH_MARKS = 'marks', 'keyframes'
SETTINGS = {'recipe': 'foreign', 'size': 64, 'threads': 1, 'save_every': 10 ** 6}
CUTS = {'ogbench/cube': '24,20,96'}  # --crop, px of 128: where hand and cube move


def held_out_of(folder):
    """Return the folder of the bag whose demonstrations are held out."""
    return Path(f'{folder}-held-out')


def place_marks(folder, demonstrations, seed):
    """
    Mark demonstrations as a person would: the middle of the bottleneck, off by up to 1.5 frames.

    :return: the MARKED ones that a seed marks, and the frame of each.
    """
    rng = np.random.default_rng([seed, *folder.name.encode()])
    marked = demonstrations[seed * MARKED:][:MARKED]
    return marked, [int(np.clip(round(sum(one.window) / 2 + rng.uniform(-1.5, 1.5)),
                                1, len(one.frames) - 2)) for one in marked]


def marks_of(folder, seed):
    """Return the file of the marks that a seed has."""
    return Path(folder, f'marks_{seed}.json')


def mark(folder, demonstrations, seed):
    """Write the marks of a seed beside the bag, see place_marks."""
    from tap_ros.recording.cache import open_recordings
    from tap_ros.recording.marks import write_marks
    write_marks(marks_of(folder, seed), open_recordings([folder]), [folder], {
        one.number: [(t, t)] for one, t in zip(*place_marks(folder, demonstrations, seed))})


def train_all(folders, methods, seeds, out, engine):
    """Train and score all that is not done; return rows of what train_and_score returns."""
    work = [Work(f'{task}/{method}/{seed}', train_and_score, (
                str(folder), method, seed, str(Path(out, task, f'{method}_{seed}')),
                CUTS.get(task, '')))
            for seed in range(seeds) for task, folder in folders.items() for method in methods]
    rows = []
    with Progress(total=len(work), unit='training') as bar:
        for task, get in run_tasks(work, engine):
            name, method, number = task.name.rsplit('/', 2)
            rows.append({'task': name, 'method': method, 'seed': int(number), **get()})
            bar.update()
            bar.write(f'{task.name}: ' + ', '.join(
                f'{np.mean(rows[-1][key]):.0%}' for key in ('hit', 'near')))
    return rows


def train_and_score(folder, method, seed, out, crop=''):
    """
    Train a predictor and score it on the held-out episodes whose bottleneck is known.

    :return: dict of lists (N,): hit and near, 0 or 1, is the nearest frame in the bottleneck, or
        at most one beside it; error, of its middle frame; copying, of an input against that.
    """
    from sim_bridge.collect import BOTTLENECKS_FILE
    from tap_ros.apps.train import train
    from tap_ros.evaluation.hits import is_hit
    from tap_ros.evaluation.prediction import evaluate
    from tap_ros.prediction.predictor import load_network
    from tap_ros.recording.bags import reading_like
    from tap_ros.recording.cache import open_recordings
    from tap_ros.recording.marks import read_marks
    import torch
    path = Path(out, 'hits.json')
    if path.exists():
        return json.loads(path.read_text())
    torch.set_num_threads(1)
    marks = {'marks': str(marks_of(folder, seed))} if method in WITH_MARKS else {}
    Path(out).mkdir(parents=True, exist_ok=True)
    with open(Path(out, 'log.txt'), 'a') as log, redirect_stderr(log):
        weights = train(folder, out, seed=seed, held_out=(str(held_out_of(folder)),),
                        crop=crop, **SETTINGS, **METHODS[method], **marks)
    network, training = load_network(weights)
    bag = held_out_of(folder)
    store = open_recordings([bag], reading=reading_like(training, [bag]))
    truth = read_marks(bag / BOTTLENECKS_FILE, store).episodes
    known = sorted(truth)
    found = evaluate(network, store, known, marks=truth)['prediction']
    scores = {name: [int(is_hit(truth[i], t, beside)) for i, t in zip(known, found.match_step)]
              for name, beside in (('hit', 0), ('near', 1))} | {
        'error': found.at_mark.tolist(), 'copying': found.copying_at_mark.tolist()}
    write_atomically(path, json.dumps(scores) + '\n')
    return scores
