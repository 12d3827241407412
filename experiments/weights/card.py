# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights to ship: those of a run at half the size, a model card and pictures beside them."""

import json
from pathlib import Path

from experiments.pages import render
import numpy as np
import pandas as pd
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.evaluation.prediction import evaluate
from tap_ros.evaluation.samples import SAMPLES, score_samples
from tap_ros.evaluation.shown import SHOWN
from tap_ros.evaluation.strips import write_strips
from tap_ros.files import write_atomically
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import open_recordings
from tap_ros.training.weights import load_weights, save_weights
import torch

THRESHOLD = 2  # px, of the bottleneck frequency on the card
PICTURED = 4  # successes and failures each
_BOTTLENECKS = f'bottleneck_{THRESHOLD}px'
_COLUMNS = {  # of the table: what EpisodeScores.intervals calls it, and digits
    'min l1': ('min_l1', 4), 'match-step, share of the episode': ('match_fraction', 2),
    f'bottlenecks at {THRESHOLD} px': (_BOTTLENECKS, 2),
    'shows the hand': ('shows_hand', 2), 'shows the objects': ('shows_objects', 2),
    'shows both': ('shows_both', 2)}


def ship(name, task, run, fresh, out, commands):
    """
    Write a run's weights as float16, with a card and a picture.

    :param name: of the recipe; task: of its scenes.
    :param run: folder of the training.
    :param fresh: folder of the recording of scenes that it never saw.
    :param out: folder to write into.
    :param commands: lines: those that collect, that of the fresh scenes, that of the training.
    :return: Path of the card.
    """
    run = Path(run)
    config, state, about = load_weights(run / 'predictor.safetensors', 'predictor')
    state = {name: value.to(torch.float16) if value.is_floating_point() else value
             for name, value in state.items()}
    file = Path(out, f'predictor_{name}.safetensors')
    save_weights(file, state, 'predictor', config, about)
    network, _ = load_network(file)
    store = open_recordings([str(fresh)], progress=False)
    episodes = np.arange(len(store))
    forward = config['num_context'] == 1
    goals = ['none' if forward else 'last frame']
    if not forward and not np.array_equal(store[0].goal_frame, store[0].frames[-1]):
        goals.append('arm elsewhere')
    scores = {goal: evaluate(network, store, episodes, goal_picture=_option(goal))
              for goal in goals}
    first = scores[goals[0]]['prediction']
    samples = sample_facts(network, store, episodes) if network.config.latent_size else None
    good = found(first)
    shown = [*np.flatnonzero(good)[:PICTURED], *np.flatnonzero(~good)[:PICTURED]]
    write_strips(file.with_suffix('.png'), network, store, shown, 'last')
    card = file.with_suffix('.md')
    *collect, again, train = commands
    write_atomically(card, render(
        'weights/templates/card.md.j2', file=file.name, name=name, task=task,
        collect=collect, again=again, train=train,
        run=json.loads((run / 'run.json').read_text()),
        fresh=len(store), pushing=np.isfinite(first.bottleneck).any(), forward=forward,
        goal=goals[0], metrics=headline(first), samples=samples,
        scores=tabulate(scores), succeed=int(good[shown].sum()),
        fail=int((~good[shown]).sum())))
    return card


def headline(scores):
    """
    Choose what the card's front matter tells: (name, title, value) each, for model hubs.

    :param scores: EpisodeScores of predictions.
    """
    known = scores.intervals()
    titles = {name: (title, digits) for title, (name, digits) in _COLUMNS.items()}
    names = ('min_l1', _BOTTLENECKS if _BOTTLENECKS in known else 'shows_both')
    return [(name, titles[name][0], round(known[name].value, titles[name][1]))
            for name in names if name in known]


def sample_facts(network, store, episodes):
    """
    Measure 100 samples of each episode, goal picture the last frame.

    :param network: Predictor with z.
    :param store: the EpisodeStore.
    :param episodes: indices of episodes.
    :return: dict of texts for the card: their number, the best one's error with its interval, and
        how much they differ: in px where positions are known, and in the pixels near objects.
    """
    samples = score_samples(network, store, episodes)
    least = mean_interval(samples.min_l1)
    placed = samples.spread_px[np.isfinite(samples.spread_px)]
    return {'count': SAMPLES, 'placed': f'{placed.mean():.1f}' if len(placed) else '',
            'near': f'{np.nanmean(samples.spread_near):.4f}',
            'best': f'{least.value:.4f} ({least.low:.4f} to {least.high:.4f})'}


def found(scores):
    """
    Say of each episode whether its prediction is what it should be.

    :param scores: EpisodeScores of predictions.
    :return: bool (N,): a bottleneck within THRESHOLD where objects are pushed; else whether both
        hand and objects are shown.
    """
    if np.isfinite(scores.bottleneck).any():
        return scores.bottleneck <= THRESHOLD
    return np.minimum(scores.hand, scores.objects) >= SHOWN


def tabulate(scores):
    """
    Make the card's table.

    :param scores: dict from a description of the goal picture to {method: EpisodeScores}.
    :return: DataFrame, a line for each goal picture and method; what is not known has no column.
    """
    lines = {(goal, method): score.intervals()
             for goal, methods in scores.items() for method, score in methods.items()}
    table = pd.DataFrame(list(lines), columns=['goal picture', 'method'])
    pushing = any(_BOTTLENECKS in line for line in lines.values())
    for title, (name, digits) in _COLUMNS.items():
        if pushing and name.startswith('shows'):
            continue  # of a bottleneck the hand is no part
        known = [line.get(name, [np.nan] * 3) for line in lines.values()]
        if np.isfinite(np.array(known, float)).any():
            table[title] = [
                '{:.{n}f} ({:.{n}f} to {:.{n}f})'.format(*row, n=digits)
                if np.isfinite(row).all() else None for row in known]
    return table


def _option(goal):
    """Return what `evaluate prediction --goal-picture` calls it."""
    return 'recorded' if goal == 'arm elsewhere' else 'last'
