# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the list of runs, and of the numbers that are made from their scores."""

from dataclasses import asdict
import json
from pathlib import Path

from experiments.paper.results import load_runs, on_same_episodes, write_results
from experiments.paper.rows import as_frame, group_runs, make_rows
from experiments.paper.runs import FINE_TUNED, paper_runs, PAST_VARIANTS, SCALES
import numpy as np
import pytest
from tap_ros.errors import ConfigError
from tap_ros.prediction.methods import method_fields, todays_settings
from tap_ros.prediction.training_config import DEFAULTS
from tap_ros.training.settings import FREE

ROOT = Path(__file__).parents[2]
EVERY = [run for scale in SCALES for run in paper_runs(scale)]
EPISODES = 40


def test_every_run_can_be_trained_as_its_name_says():
    for run in EVERY:
        config = run.config('bags', 'runs/paper')
        assert method_fields(config.method) == method_fields(run.method)
        assert config.mode == run.mode
        assert config.seed == run.seed
        assert config.goal_picture == ('mixed' if run.task in FINE_TUNED else 'last')
        assert config.outer_power == 1
        assert config.recordings == (f'bags/{run.task}',)
        assert config.out == f'runs/paper/{run.scale}/{run.name}'
        assert config.skips == (config.decoder == 'shared') == ('+skips' in run.variant)
        if 'progress' not in run.method and 'margin' not in run.variant:
            assert config.margin == 0


def test_names_are_unique_and_the_first_seed_comes_first():
    for scale in SCALES:
        runs = paper_runs(scale, seeds=(0, 1))
        assert len({run.name for run in runs}) == len(runs)
        assert runs[:len(runs) // 2] == paper_runs(scale, seeds=(0,))
        usual = paper_runs(scale)
        assert sorted(run.seed for run in usual) == [run.seed for run in usual]
        assert usual[:len(runs) // 2] == paper_runs(scale, seeds=(0,))
        assert {run.seed for run in usual} == {0, 1, 2}


def test_finished_runs_have_the_settings_of_today():
    runs = {(run.scale, run.name): run for run in EVERY}
    files = sorted(ROOT.glob('docs/results/runs/*/*.json'))
    assert files
    for path in files:
        if any(past in path.stem for past in PAST_VARIANTS):
            continue
        stored = {**DEFAULTS, **todays_settings(json.loads(path.read_text())['config'])}
        config = asdict(runs[path.parent.name, path.stem].config('bags', 'runs'))
        for name in {**stored, **config}.keys() - {*FREE, 'precision'}:
            assert stored[name] == config[name], (path.stem, name)


def scores(l1, at=0.5, bottleneck=None):
    """
    Invent the scores of one method.

    :param l1: mean of min_l1, or its values.
    :param at: mean of match_fraction.
    :param bottleneck: values, None for a task without.
    """
    rng = np.random.default_rng(0)
    if np.ndim(l1) == 0:
        l1 = l1 * rng.uniform(0.5, 1.5, EPISODES)
    at = np.clip(rng.normal(at, 0.1, EPISODES), 0.02, 0.98)
    none = [None] * EPISODES
    return {'min_l1': list(map(float, l1)), 'match_fraction': list(map(float, at)),
            'match_step': [round(x * 39) for x in at], 'changed_l1': [0.2] * EPISODES,
            'bottleneck': bottleneck or none, 'object_mass': [1.0] * 40 if bottleneck else none}


def made_run(method, prediction, task='push2', mode='bidirectional', new_pixels=True, seed=0):
    """Invent a run."""
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
                       'prediction': prediction, **copies}}


def save_runs(folder, runs):
    """Write runs to where results.write_results looks for them."""
    for run in runs:
        path = folder / 'runs' / run['scale'] / f'{run["name"]}.json'
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(run))


def rows_of(*runs):
    return as_frame(make_rows(group_runs(runs)))


def find(rows, **wanted):
    """Return the first row that fits as a dict, or None; one without new_pixels fits any."""
    for name, value in wanted.items():
        rows = rows[(rows[name] == value).fillna(name == 'new_pixels')]
    return None if rows.empty else rows.iloc[0].dropna().to_dict()


def test_gains_are_paired_by_episode():
    # Errors differ a lot between episodes, but one method's are always half of the other's.
    errors = np.random.default_rng(0).uniform(0.001, 0.1, EPISODES)
    rows = rows_of(made_run('fix', scores(errors)), made_run('min', scores(errors / 2)))
    gain = find(rows, method='min', metric='gain_over_fix')
    assert (gain['value'], gain['ci_low'], gain['ci_high']) == pytest.approx((0.5,) * 3)
    assert gain['baseline'] == 'fix'
    error = find(rows, method='min', metric='min_l1')
    assert error['ci_high'] - error['ci_low'] > 0.005


def test_numbers_of_other_recordings_are_left_out():
    runs = [made_run('fix', scores(0.02)), made_run('min', scores(0.02)),
            made_run('genmin', scores(0.01)), made_run('genmin4', scores(0.01), mode='forward')]
    runs[1]['data']['hash'] = 'of another machine'
    runs[2]['evaluation']['copy-start']['min_l1'][7] += 1e-5  # another episode
    kept, left_out = on_same_episodes(runs)
    assert [run['method'] for run in kept] == ['fix', 'min', 'genmin4']
    assert [run['method'] for run in left_out] == ['genmin']


def test_a_damaged_file_is_named(tmp_path):
    save_runs(tmp_path, [made_run('fix', scores(0.02))])
    path = tmp_path / 'runs' / 'small' / 'broken.json'
    path.write_text('{"name": ')
    with pytest.raises(ConfigError, match='broken.json'):
        load_runs(tmp_path / 'runs')


def test_results_are_the_same_when_made_again(tmp_path):
    save_runs(tmp_path, [made_run('fix0.50', scores(0.02), task='grasp', mode='forward'),
                         made_run('fix', scores(0.02, bottleneck=[1.0] * 40), new_pixels=False,
                                  task='push2_early')])
    rows = write_results(tmp_path, pictures=False)
    written = {path.name: path.read_bytes() for path in tmp_path.glob('*.*')}
    assert written['prediction.csv'].decode().count('\n') == len(rows) + 1
    assert set(written) == {'prediction.csv', 'forward_scatter.png', 'timing.png'}
    write_results(tmp_path, pictures=False)
    assert {path.name: path.read_bytes() for path in tmp_path.glob('*.*')} == written
    with pytest.raises(ConfigError, match='tap_ros paper'):
        write_results(tmp_path / 'nothing')
