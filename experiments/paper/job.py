# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What one process of a sweep does: collect a recording, or train and score one run.

Each is safe to stop at any moment: recordings and trainings go on from where they were, and the
result of a run appears when it is complete.
"""

from dataclasses import asdict
import json
from pathlib import Path
import sys
import time

from experiments.paper.places import (
    collect_command,
    collected_episodes,
    Places,
    read_json,
)
from experiments.paper.runs import PaperRun
import numpy as np
from tap_ros.errors import ConfigError, TapError
from tap_ros.files import locked, write_atomically

DONE, FAILED, BUSY, UNFINISHED = 0, 1, 73, 75  # exit statuses
_DIGITS = 5
_LEFT_BY_TRAINING = ('checkpoint.safetensors', 'predictor.safetensors', 'config.json', 'run.json',
                     'scores.json')


def collect_task(task, episodes, places, workers=None):
    """
    Collect the recording of a task, or what it lacks; wait if another sweep is at it.

    :param task: of sim_bridge.tasks.
    :param episodes: how many at least.
    :param places: Places.
    :param workers: processes; None: one a core.
    """
    from sim_bridge.collect import collect, CollectConfig

    folder = places.recording(task)
    with locked(Path(places.recordings) / f'.{task}.lock', wait=True):
        episodes = max(episodes, collected_episodes(folder))
        collect(folder, CollectConfig(task=task, episodes=episodes), workers, progress=False)
    return DONE


def perform(run, places, minutes=None, fresh=False):
    """
    Train a run, or go on with it, and score it once it is trained.

    :param run: PaperRun.
    :param places: Places.
    :param minutes: stop training after so many; None: never.
    :param fresh: forget a training that was begun.
    :return: DONE, UNFINISHED if the time was not enough, BUSY if another process is at it.
    :raises ConfigError: if the run that it begins with is not trained.
    """
    from tap_ros.prediction.training import train

    config, folder = run.config(places.recordings, places.runs), run.folder(places.runs)
    with locked(folder / 'lock') as mine:
        if not mine:
            return BUSY
        _check_before(run.before, places)
        for name in _LEFT_BY_TRAINING if fresh else ():
            (folder / name).unlink(missing_ok=True)
        weights = train(config, minutes=minutes, progress=False)
        if read_json(folder / 'run.json')['steps'] < config.steps:
            return UNFINISHED
        write_atomically(places.result(run),
                         json.dumps(score(run, config, weights, places)) + '\n')
    return DONE


def _check_before(run, places):
    """Refuse to begin with weights that are not there or half trained."""
    if run is None:
        return
    from experiments.paper.sweep import trained_steps

    steps = trained_steps(run, places)
    if steps < run.num_steps:
        raise ConfigError(f'the weights of {run.name}, to begin with, are trained for {steps} of '
                          f'{run.num_steps} steps with these settings; first: {run.command}')


def score(run, config, weights, places):
    """
    Score a trained run on the episodes of its task that training held out.

    :param run: PaperRun.
    :param config: its TrainingConfig.
    :param weights: path of the weights.
    :param places: Places.
    :return: dict for a JSON file: what the run was, and a number for each held-out episode.
    :raises ConfigError: if no episode was held out.
    """
    from tap_ros.evaluation.bottleneck import target_bottlenecks
    from tap_ros.evaluation.prediction import evaluate
    from tap_ros.evaluation.samples import score_samples
    from tap_ros.learning.devices import pick_device
    from tap_ros.learning.split import split_episodes
    from tap_ros.prediction.predictor import load_network
    from tap_ros.recording.cache import open_recordings

    network, about = load_network(weights, pick_device(config.device))
    store = open_recordings(list(config.recordings), progress=False)
    own = open_recordings(list(config.recordings[-1:]), progress=False)
    _, held_out = split_episodes(store, config.test_fraction)
    held_out = held_out[held_out >= len(store) - len(own)]
    if not len(held_out):
        raise ConfigError(f'{config.recordings[-1]}: no episode of it is held out; collect more')
    began = time.perf_counter()
    scores = {method: _rounded(value) for method, value in
              evaluate(network, store, held_out).items()}
    fraction = config.chosen.fraction
    if fraction is not None and config.mode == 'bidirectional':
        scores['target_bottleneck'] = _rounded_list(
            target_bottlenecks([store[i] for i in held_out], fraction, 'last'))
    if network.config.latent_size:
        samples = _rounded(score_samples(network, store, held_out))
        for name in [name for name in samples if name.startswith('spread')]:
            scores[f'sample_{name}'] = samples.pop(name)
        scores['best_of_100'] = samples
    seconds = round(time.perf_counter() - began, 1)
    return {
        'name': run.name, 'task': run.task, 'mode': run.mode, 'method': run.method,
        'new_pixels': run.new_pixels, 'seed': run.seed, 'scale': run.scale,
        'recursion': run.recursion, 'variant': run.variant, 'command': run.command,
        'config': asdict(config),
        'data': {'hash': own.data_hash, 'trained_on': store.data_hash,
                 'episodes': about['episodes'], 'held_out': len(held_out),
                 'command': '; '.join(filter(None, (collect_command(
                     places.recording(task)) for task in run.training_tasks)))},
        'training': {name: about[name]
                     for name in ('steps', 'seconds', 'machine', 'torch', 'python')},
        'evaluation': {'margin': 0, 'goal_picture': 'last', 'seconds': seconds, **scores}}


def main(argument):
    """
    Do one job.

    :param argument: JSON of {'places'}, with {'collect', 'episodes', 'workers'} or with {'run',
        'minutes', 'fresh'}.
    :return: exit status.
    """
    job = json.loads(argument)
    places = Places(**job['places'])
    try:
        if 'collect' in job:
            return collect_task(job['collect'], job['episodes'], places, job['workers'])
        return perform(PaperRun(**job['run']), places, job['minutes'], job['fresh'])
    except TapError as error:
        print(f'error: {error}', file=sys.stderr)
        return FAILED


def _rounded(scores):
    """Turn a dataclass of arrays into lists of few digits, None for NaN."""
    return {name: _rounded_list(values) for name, values in vars(scores).items()}


def _rounded_list(values):
    return [None if np.isnan(x) else round(float(x), _DIGITS) if x % 1 else int(x)
            for x in values]


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
