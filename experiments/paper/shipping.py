# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights to ship: those of a finished run at half the size, with a model card beside them."""

from pathlib import Path

from experiments.paper.places import read_json
from experiments.paper.published import TITLES
from experiments.paper.runs import label
from experiments.paper.sweep import trained_on
from experiments.paper.tables import markdown
import numpy as np
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
    config, data, training = result['config'], result['data'], result['training']
    name = label(result['method'], result.get('variant', ''), result.get('recursion', 1))
    kind = ('Predicts a later picture from a start picture alone' if result['mode'] == 'forward'
            else 'Predicts a subgoal picture between a start and a goal picture')
    task = TITLES.get(result['task'], result['task'])
    settings = ', '.join(f'{key} {config[key]}' for key in _SETTINGS
                         if config.get(key) not in (None, ''))
    lines = [
        f'# {file.name}\n',
        f'{kind}. Task: {task.lower()}; method: {name} (see docs/paper_map.md). Stored as '
        'float16.\n',
        markdown(['', ''], [
            ['data', f'`{data["command"]}`: {data["episodes"]} episodes to train on, '
                     f'{data["held_out"]} held out; hash `{trained_on(result)[:12]}`'],
            ['training', f'`{result["command"]}`'],
            ['settings', settings],
            ['time', f'{training["seconds"] / 60:.0f} min on {training["machine"]}; '
                     f'torch {training["torch"]}'],
            ['use', '`ros2 run tap_ros predictor_node --ros-args -p weights:=<this file>`']],
                 left=2),
        '\nScores of this file on the held-out episodes, with 95% intervals over them; l1 is the '
        'per-pixel mean on [0, 1]. Copying an input is scored too: a low l1 alone says nothing. '
        'One training of one seed.\n',
        markdown(['goal picture', 'method', 'min l1', 'of changed pixels',
                  'match-step, share of the episode', f'bottlenecks at {THRESHOLD} px'],
                 [row for goal, methods in scores.items() for row in _rows(goal, methods)],
                 left=2),
        *_samples(result['evaluation']),
        '\nOf changed pixels: the error over those pixels alone in which the matched frame '
        'differs from every input. What the picture shows and what it lacks: docs/results.\n',
        '\nTrained on pictures of this simulated world alone; other cameras, arms and objects '
        'need training of their own.']
    return '\n'.join(lines) + '\n'


def _samples(evaluation):
    """Say how good the best of 100 samples is and how much samples differ, if there are any."""
    if 'best_of_100' not in evaluation:
        return []
    best = mean_interval(np.array(evaluation['best_of_100']['min_l1'], float))
    near, elsewhere = (np.nanmean(np.array(evaluation[f'sample_spread_{where}'], float))
                       for where in ('near', 'elsewhere'))
    return [f'\nThe best of 100 samples, goal picture the last frame: min l1 {_text(best, 4)}. '
            f'Samples differ by {near:.4f} on average around the objects and {elsewhere:.4f} '
            'elsewhere (standard deviation on [0, 1]).']


def _rows(goal, methods):
    """Write a line for each method."""
    for method, scores in methods.items():
        placed = scores.bottleneck[np.isfinite(scores.bottleneck)]
        changed = scores.changed_l1[np.isfinite(scores.changed_l1)]
        yield [goal, method, _text(mean_interval(scores.min_l1), 4),
               _text(mean_interval(changed), 3) if len(changed) else '-',
               _text(mean_interval(scores.match_fraction), 2),
               _text(mean_interval(placed <= THRESHOLD), 2) if len(placed) else '-']


def _text(interval, digits):
    """Write an Interval."""
    value, low, high = (f'{x:.{digits}f}' for x in interval)
    return f'{value} ({low} to {high})'
