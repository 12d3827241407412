# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights to ship: those of a finished run at half the size, with a model card beside them."""

from pathlib import Path

from experiments.pages import interval, render
from experiments.paper.places import read_json
from experiments.paper.published import TITLES
from experiments.paper.runs import label
from experiments.paper.sweep import trained_on
import numpy as np
import pandas as pd
from tap_ros.errors import ConfigError
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.evaluation.prediction import evaluate
from tap_ros.files import write_atomically
from tap_ros.learning.split import split_episodes
from tap_ros.learning.weights import load_weights, save_weights
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import open_recordings
import torch

THRESHOLD = 2  # px, of the bottleneck frequency on the card
_SETTINGS = ('method', 'mode', 'new_pixels', 'base_width', 'steps', 'batch_size', 'learning_rate',
             'margin', 'outer_power', 'changed_weight', 'goal_picture', 'recursion', 'gan_weight',
             'kl_weight', 'latent_size', 'initial_weights', 'seed')


def ship(run, file, places):
    """
    Write a run's weights as float16, and a card beside them that says what they are.

    :param run: PaperRun that is done, with its weights and its recording at hand.
    :param file: .safetensors to write; the card gets the same name with .md.
    :param places: Places.
    :return: Path of the card.
    :raises ConfigError: if the run is not done, or its recording is not at hand.
    """
    result, file = read_json(places.result(run)), Path(file)
    if result is None:
        raise ConfigError(f'{run.name} is not done; make it with: {run.command}')
    source = run.folder(places.runs) / 'predictor.safetensors'
    config, state, about = load_weights(source, 'predictor')
    if not places.recording(run.task).exists():
        raise ConfigError(f'{places.recording(run.task)}: needed for the scores on the card; make '
                          f'it with: {result["data"]["command"]}')
    state = {name: value.to(torch.float16) if value.is_floating_point() else value
             for name, value in state.items()}
    save_weights(file, state, 'predictor', config, about)
    card = file.with_suffix('.md')
    write_atomically(card, make_card(file, result, score(file, places.recording(run.task))))
    return card


def score(file, recording):
    """
    Score weights on held-out episodes, as they are on disk.

    :param file: of a predictor.
    :param recording: of its task, among what it was trained on.
    :return: dict from a description of the goal picture to {method: EpisodeScores}.
    """
    network, about = load_network(file)
    store = open_recordings([str(recording)], progress=False)
    _, held_out = split_episodes(store, about['settings']['test_fraction'])
    if network.config.num_context == 1:
        return {'none': evaluate(network, store, held_out)}
    scores = {'last frame': evaluate(network, store, held_out)}
    # Where a recording has goal pictures of its own, they show the arm elsewhere.
    if not np.array_equal(store[held_out[0]].goal_frame, store[held_out[0]].frames[-1]):
        scores['arm elsewhere'] = evaluate(network, store, held_out, goal_picture='recorded')
    return scores


def make_card(file, result, scores):
    """
    Write a model card.

    :param file: Path of the weights.
    :param result: the run's JSON.
    :param scores: of score.
    :return: markdown.
    """
    kind = ('Predicts a later picture from a start picture alone' if result['mode'] == 'forward'
            else 'Predicts a subgoal picture between a start and a goal picture')
    settings = [f'{key} {result["config"][key]}' for key in _SETTINGS
                if result['config'].get(key) not in (None, '')]
    return render(
        'paper/templates/card.md.j2', file=file.name, kind=kind, result=result, settings=settings,
        method=label(result['method'], result.get('variant', ''), result.get('recursion', 1)),
        task=TITLES.get(result['task'], result['task']), hash=trained_on(result)[:12],
        scores=_table(scores), **_samples(result['evaluation']))


def _samples(evaluation):
    """Return how good the best of 100 samples is and how much samples differ, if there are any."""
    if 'best_of_100' not in evaluation:
        return {'best': None}
    near, elsewhere = (np.nanmean(np.array(evaluation[f'sample_spread_{where}'], float))
                       for where in ('near', 'elsewhere'))
    best = np.array(evaluation['best_of_100']['min_l1'], float)
    return {'best': _means([best], 4)[0], 'near': near, 'elsewhere': elsewhere}


def _table(scores):
    """Tabulate the means over the episodes, a line for each goal picture and method."""
    keys = [(goal, method) for goal, methods in scores.items() for method in methods]
    lines = [scores[goal][method] for goal, method in keys]
    placed = [line.bottleneck[np.isfinite(line.bottleneck)] <= THRESHOLD for line in lines]
    return pd.DataFrame(keys, columns=['goal picture', 'method']).assign(**{
        'min l1': _means([line.min_l1 for line in lines], 4),
        'of changed pixels': _means([line.changed_l1 for line in lines], 3),
        'match-step, share of the episode': _means([line.match_fraction for line in lines], 2),
        f'bottlenecks at {THRESHOLD} px': _means(placed, 2)})


def _means(values, digits):
    """Write the mean of each array with its interval; NaN for arrays without a known value."""
    known = [array[np.isfinite(array)] for array in values]
    return interval(pd.DataFrame(
        [mean_interval(array) if len(array) else [np.nan] * 3 for array in known],
        columns=['value', 'ci_low', 'ci_high']), digits)
