# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights to ship: those of a run at half the size, a model card and pictures beside them."""

import json
from pathlib import Path

from experiments.pages import render
import numpy as np
import pandas as pd
from tap_ros.base.files import write_atomically
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.evaluation.prediction import evaluate
from tap_ros.evaluation.samples import SAMPLES, score_samples
from tap_ros.evaluation.shown import SHOWN
from tap_ros.evaluation.strips import draw_strips
from tap_ros.images.drawing import png_bytes
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import open_recordings
from tap_ros.weights.weights import load_weights, save_weights
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

    :param fresh: folder of the recording of scenes that it never saw.
    :param commands: lines: those that collect, that of the fresh scenes, that of the training.
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
    goal = 'none' if forward else 'last frame'
    goals = {goal: 'last'}
    if not forward and not np.array_equal(store[0].goal_frame, store[0].frames[-1]):
        goals['arm elsewhere'] = 'recorded'
    scores = {name: evaluate(network, store, episodes, goal_picture=picture)
              for name, picture in goals.items()}
    first = scores[goal]['prediction']
    known = first.intervals()
    metrics = [(name, title, round(known[name].value, digits))
               for title, (name, digits) in _COLUMNS.items() if name in known and name in (
                   'min_l1', _BOTTLENECKS if _BOTTLENECKS in known else 'shows_both')]
    samples = None
    if network.config.latent_size:
        drawn = score_samples(network, store, episodes)
        placed = drawn.spread_px[np.isfinite(drawn.spread_px)]
        samples = {'count': SAMPLES, 'placed': f'{placed.mean():.1f}' if len(placed) else '',
                   'spread': f'{drawn.spread.mean():.4f}',
                   'best': '{:.4f} ({:.4f} to {:.4f})'.format(*mean_interval(drawn.min_l1))}
    good = found(first)
    shown = [*np.flatnonzero(good)[:PICTURED], *np.flatnonzero(~good)[:PICTURED]]
    write_atomically(file.with_suffix('.png'), png_bytes(draw_strips(network, store, shown)))
    card = file.with_suffix('.md')
    *collect, again, train = commands
    write_atomically(card, render(
        'weights/templates/card.md.j2', file=file.name, name=name, task=task,
        collect=collect, again=again, train=train,
        run=json.loads((run / 'run.json').read_text()),
        fresh=len(store), pushing=np.isfinite(first.bottleneck).any(), forward=forward,
        goal=goal, metrics=metrics, samples=samples,
        scores=tabulate(scores), succeed=int(good[shown].sum()),
        fail=int((~good[shown]).sum())))
    return card


def found(scores):
    """Say of each episode whether its bottleneck is found, or hand and object are shown."""
    if np.isfinite(scores.bottleneck).any():
        return scores.bottleneck <= THRESHOLD
    return np.minimum(scores.hand, scores.objects) >= SHOWN


def tabulate(scores):
    """Make the card's table of {goal picture: {method: EpisodeScores}}, without empty columns."""
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
