# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Finished runs with invented scores, in the form in which the sweep leaves them."""

import json

import numpy as np

EPISODES = 40


def scores(l1, at=0.5, frames=40, bottleneck=None, mass=None, seed=0):
    """
    Invent the scores of one method.

    :param l1: mean of min_l1, or its values.
    :param at: mean of match_fraction, or its values.
    :param bottleneck: values, None for a task without.
    :param mass: values, None for 1.
    """
    rng = np.random.default_rng(seed)
    if np.ndim(l1) == 0:
        l1 = l1 * rng.uniform(0.5, 1.5, EPISODES)
    if np.ndim(at) == 0:
        at = np.clip(rng.normal(at, 0.1, EPISODES), 0.02, 0.98)
    N = len(l1)
    return {'min_l1': list(map(float, l1)), 'match_fraction': list(map(float, at)),
            'match_step': [round(x * (frames - 1)) for x in at],
            'changed_l1': [0.2] * N,
            'bottleneck': [None] * N if bottleneck is None else list(bottleneck),
            'object_mass': [None] * N if bottleneck is None else list(mass or [1.0] * N)}


def made_run(method, prediction, task='push2', mode='bidirectional', new_pixels=True, seed=0,
             **evaluation):
    """Invent a run; `evaluation` has more parts than prediction."""
    name = f'{task}-{mode}-{method}{"" if new_pixels else "-warp"}-s{seed}'
    copies = {'copy-start': scores(0.003, 0.03)}
    if mode == 'bidirectional':
        copies['copy-goal'] = scores(0.003, 0.97)
    return {
        'name': name, 'task': task, 'mode': mode, 'method': method, 'new_pixels': new_pixels,
        'seed': seed, 'scale': 'small', 'command': f'make {name}',
        'config': {'recordings': ['nowhere'], 'batch_size': 32, 'base_width': 16},
        'data': {'hash': 'd', 'episodes': 800, 'held_out': len(prediction['min_l1']),
                 'command': 'collect it'},
        'training': {'steps': 3000, 'seconds': 600.0, 'machine': 'a machine', 'torch': '2',
                     'python': '3'},
        'evaluation': {'margin': 0, 'goal_picture': 'last', 'seconds': 1.0,
                       'prediction': prediction, **copies, **evaluation}}


def save_runs(folder, runs):
    """Write runs to where results.write_results looks for them."""
    for run in runs:
        path = folder / 'runs' / run['scale'] / f'{run["name"]}.json'
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(run))
