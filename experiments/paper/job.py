# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a sweep is made of: collect a recording, or train and score one run.

Each is safe to stop at any moment: recordings and trainings go on from where they were, and the
result of a run appears when it is complete.
"""

from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict
import json
import math
from pathlib import Path
import time
import traceback

from experiments.paper.places import (
    collected_episodes,
    file_hash,
    read_json,
    recording_hash,
)
from experiments.paper.recordings import RECORDINGS
import numpy as np
from tap_ros.engines import LOCAL
from tap_ros.errors import ConfigError, TapError
from tap_ros.files import locked, write_atomically

DONE, FAILED, BUSY, UNFINISHED = 'done', 'failed', 'busy', 'unfinished'
_DIGITS = 5
_LEFT_BY_TRAINING = ('checkpoint.safetensors', 'predictor.safetensors', 'config.json', 'run.json',
                     'scores.json')


def collect_task(task, episodes, places, engine=LOCAL, deadline=math.inf,
                 progress=False):
    """
    Collect the recording of a task, or what it lacks; wait if another sweep is at it.

    :param task: of recordings.RECORDINGS.
    :param episodes: how many at least.
    :param places: Places.
    :param engine: Engine.
    :param deadline: time.time() after which no other file begins.
    :param progress: whether to show a progress bar.
    :return: DONE, or UNFINISHED if the time was not enough.
    """
    from sim_bridge.collect import collect

    folder = places.recording(task)
    with locked(Path(places.recordings) / f'.{task}.lock', wait=True):
        episodes = max(episodes, collected_episodes(folder))
        found = collect(folder, RECORDINGS[task].collection(episodes), engine,
                        progress, stop=lambda: time.time() > deadline)
    return DONE if found['whole'] else UNFINISHED


def logged(run, places, deadline, fresh):
    """
    Perform a run; what there is to say goes into its folder's log.txt.

    :param deadline: time.time() at which training stops; it goes on another time.
    :return: as perform, or FAILED.
    """
    log = run.folder(places.runs) / 'log.txt'
    log.parent.mkdir(parents=True, exist_ok=True)
    minutes = None if math.isinf(deadline) else max(deadline - time.time(), 1) / 60
    with open(log, 'w') as file, redirect_stdout(file), redirect_stderr(file):
        try:
            return perform(run, places, minutes, fresh)
        except TapError as error:
            print(f'error: {error}')
        except Exception:
            traceback.print_exc()
        return FAILED


def perform(run, places, minutes=None, fresh=False):
    """
    Train a run, or go on with it, and score it once it is trained.

    :param run: PaperRun.
    :param places: Places.
    :param minutes: stop training after so many; None: never.
    :param fresh: forget a training that was begun.
    :return: DONE, UNFINISHED if the time was not enough, BUSY if another process is at it.
    """
    from tap_ros.prediction.training import train

    config, folder = run.config(places.recordings, places.runs), run.folder(places.runs)
    with locked(folder / 'lock') as mine:
        if not mine:
            return BUSY
        for name in _LEFT_BY_TRAINING if fresh else ():
            (folder / name).unlink(missing_ok=True)
        weights = train(config, minutes=minutes, progress=False)
        if read_json(folder / 'run.json')['steps'] < config.steps:
            return UNFINISHED
        write_atomically(places.result(run),
                         json.dumps(score(run, config, weights, places)) + '\n')
    return DONE


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
    from experiments.paper.recursion import score_recursion
    from tap_ros.evaluation.bottleneck import bottleneck_share, target_bottlenecks
    from tap_ros.evaluation.prediction import evaluate
    from tap_ros.evaluation.samples import score_samples
    from tap_ros.prediction.predictor import load_network
    from tap_ros.recording.cache import open_recordings
    from tap_ros.training.devices import pick_device
    from tap_ros.training.split import split_episodes
    from tap_ros.weights import find_predictor

    network, about = load_network(weights, pick_device(config.device))
    store = open_recordings(list(config.recordings), progress=False)
    _, held_out = split_episodes(store, config.test_fraction)
    if not len(held_out):
        raise ConfigError(f'{config.recordings[0]}: no episode of it is held out; collect more')
    began = time.perf_counter()
    scores = {method: _rounded(value) for method, value in
              evaluate(network, store, held_out).items()}
    if run.shifted:
        scores['shifted'] = _shifted(run, network, store, held_out, places)
    if config.new_pixels and config.mode == 'bidirectional' and config.latent == 'none':
        scores['recursion'] = [_rounded(level) for level in score_recursion(
            network, store, held_out)]
    if not config.new_pixels:
        scores['bottleneck_at'] = _rounded_list(
            [bottleneck_share(store[i]) for i in held_out])
    if config.loss == 'fix' and config.mode == 'bidirectional':
        scores['target_bottleneck'] = _rounded_list(
            target_bottlenecks([store[i] for i in held_out], config.fraction, 'last'))
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
        'data': {'hash': store.data_hash, 'episodes': about['episodes'],
                 'held_out': len(held_out),
                 'shifted': {name: recording_hash(places.recording(name))
                             for name in run.shifted},
                 **({'initial_weights': file_hash(find_predictor(config.initial_weights))}
                    if config.initial_weights else {})},
        'training': {name: about[name]
                     for name in ('steps', 'seconds', 'machine', 'torch', 'python')},
        'evaluation': {'margin': 0, 'goal_picture': 'last', 'seconds': seconds, **scores}}


def _shifted(run, network, store, held_out, places):
    """Score on other looks of scenes, and on goal pictures with the arm elsewhere."""
    from tap_ros.evaluation.prediction import evaluate
    from tap_ros.recording.cache import open_recordings

    scores = {'arm_elsewhere': evaluate(
        network, store, [i for i in held_out if store[i].goal_frame is not None],
        goal_picture='recorded')}
    for name in run.shifted:
        other = open_recordings([str(places.recording(name))], progress=False)
        scores[name] = evaluate(network, other, range(len(other)))
    return {name: {method: _rounded(value) for method, value in found.items()
                   if method != 'copy-start'} for name, found in scores.items()}


def _rounded(scores):
    """Turn a dataclass of arrays into lists of few digits, None for NaN."""
    return {name: _rounded_list(values) for name, values in vars(scores).items()}


def _rounded_list(values):
    return [None if np.isnan(x) else round(float(x), _DIGITS) if x % 1 else int(x)
            for x in values]
