# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a trained run scores on the episodes of its task that training held out."""

from dataclasses import asdict
import time

from experiments.paper.runs import SCALE
import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.evaluation.bottleneck import (
    can_be_bottleneck,
    context_pixels,
    least_sum,
    MIN_MOTION,
)
from tap_ros.evaluation.prediction import evaluate
from tap_ros.evaluation.samples import score_samples
from tap_ros.images.pixels import to_float
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.predictor import load_network
from tap_ros.recording.cache import open_recordings
from tap_ros.training.batches import fixed_time, make_batch, Sampling
from tap_ros.training.split import split_episodes
from tap_ros.weights import find_predictor
from tap_ros.weights.devices import pick_device
from tap_ros.weights.weights import stored_digest
import torch

LEVELS = 2  # of recursion
_BATCH = 64
_DIGITS = 5


def score(run, config, weights, places):
    """
    Score a trained PaperRun on the episodes of its task that training held out.

    :return: dict for a JSON file: what the run was, and a number for each held-out episode.
    """
    network, about = load_network(weights, pick_device(config.device))
    store = open_recordings(list(config.recordings), progress=False)
    _, held_out = split_episodes(store, config.test_fraction, split=config.split)
    if not len(held_out):
        raise ConfigError(f'{config.recordings[0]}: no episode of it is held out; collect more')
    began = time.perf_counter()
    scores = {method: _rounded(value) for method, value in
              evaluate(network, store, held_out).items()}
    hashes = {}
    if run.shifted:
        scores['shifted'], hashes = _shifted(run, network, store, held_out, places)
    if config.new_pixels and config.mode == 'bidirectional' and config.latent == 'none':
        scores['recursion'] = [
            {name: _rounded_list(values) for name, values in level.items()}
            for level in score_recursion(network, store, held_out)]
    if config.loss == 'fix' and config.mode == 'bidirectional':
        scores['target_bottleneck'] = _rounded_list(
            [target_bottleneck(store[i], config.fraction) for i in held_out])
    if network.config.latent_size:
        samples = _rounded(score_samples(network, store, held_out))
        scores['best_of_100'] = {name: values for name, values in samples.items()
                                 if not name.startswith('spread')}
    seconds = round(time.perf_counter() - began, 1)
    return {
        'name': run.name, 'task': run.task, 'mode': run.mode, 'method': run.method,
        'new_pixels': run.new_pixels, 'seed': run.seed, 'scale': SCALE,
        'recursion': run.recursion, 'variant': run.variant, 'command': run.command,
        'config': asdict(config),
        'data': {'hash': store.data_hash, 'episodes': about['episodes'],
                 'held_out': len(held_out),
                 'shifted': hashes,
                 **({'initial_weights': stored_digest(find_predictor(config.initial_weights))}
                    if config.initial_weights else {})},
        'training': {name: about[name]
                     for name in ('steps', 'seconds', 'machine', 'torch', 'python')},
        'evaluation': {'margin': 0, 'goal_picture': 'last', 'seconds': seconds, **scores}}


def _shifted(run, network, store, held_out, places):
    """Score on other looks of scenes, and with the arm elsewhere; return hashes, too."""
    scores, hashes = {'arm_elsewhere': evaluate(
        network, store, [i for i in held_out if store[i].goal_frame is not None],
        goal_picture='recorded')}, {}
    for name in run.shifted:
        other = open_recordings([str(places.recording(name))], progress=False)
        scores[name], hashes[name] = evaluate(network, other, range(len(other))), other.data_hash
    return {name: {method: _rounded(value) for method, value in found.items()
                   if method != 'copy-start'} for name, found in scores.items()}, hashes


def _rounded(scores):
    """Turn a dataclass of arrays into lists of few digits, None for NaN."""
    return {name: _rounded_list(values) for name, values in vars(scores).items()}


def _rounded_list(values):
    return [None if np.isnan(x) else round(float(x), _DIGITS) if x % 1 else int(x)
            for x in values]


def target_bottleneck(episode, fraction):
    """Score the true frame at a fixed time, px: whether that time is a bottleneck by itself."""
    pixels, end = context_pixels(episode, 'last'), len(episode.frames) - 1
    if not can_be_bottleneck(pixels):
        return np.nan
    target = fixed_time(fraction, end, 1, end - 1)
    gaps = torch.from_numpy(np.linalg.norm(episode.object_pixels[target] - pixels, axis=-1))
    return least_sum(gaps[:1], gaps[1:]).item()


@torch.inference_mode()
def score_recursion(network, store, episodes):
    """Return for each level of recursion (Eq. 3, Fig. 7) lists of min_l1 and of way_behind."""
    device = next(network.parameters()).device
    levels = [{'min_l1': [], 'way': []} for _ in range(LEVELS)]
    for at in range(0, len(episodes), _BATCH):
        chosen = episodes[at:at + _BATCH]
        batch = make_batch(store, chosen, Sampling(goal_picture='last')).to(device)
        context = to_float(batch.context)
        for level in levels:
            image = network(context).image
            context = torch.stack([context[:, 0], image.clamp(-1, 1)], 1)
            errors = l1_errors(batch.visible(image[:, None]), batch.targets.movedim(-1, 2))[:, 0]
            match = match_step(errors, batch.valid)[:, None]
            level['min_l1'] += errors.gather(1, match)[:, 0].tolist()
            level['way'] += [way_behind(store[i].object_pixels, time) for i, time in zip(
                chosen, batch.times.gather(1, match)[:, 0].tolist())]
    return levels


def way_behind(pixels, time):
    """Say which share of their way the moved objects of pixels (T, K, 2) have behind them."""
    way = np.linalg.norm(pixels[-1] - pixels[0], axis=-1)
    behind = np.linalg.norm(pixels[time] - pixels[0], axis=-1)[way >= MIN_MOTION]
    moved = np.minimum(behind / way[way >= MIN_MOTION], 1)
    return float(moved.mean()) if len(moved) else np.nan
