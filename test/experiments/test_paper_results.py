# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the numbers that are made from the scores of runs."""

from dataclasses import asdict
from pathlib import Path

import cv2
from experiments.paper.pictures import write_grids
from experiments.paper.results import load_runs, on_same_episodes, write_results
from experiments.paper.rows import (
    as_frame,
    group_runs,
    lower_hull,
    make_rows,
)
from made_runs import EPISODES, made_run, save_runs, scores
import numpy as np
import pytest
from tap_ros.errors import ConfigError
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.recording.cache import open_recordings
from tap_ros.training.weights import save_weights
import torch

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'
KEYS = {'task', 'mode', 'method', 'metric', 'value', 'ci_low', 'ci_high', 'n', 'seeds', 'scale',
        'runs'}


def rows_of(*runs):
    return as_frame(make_rows(group_runs(runs)))


def find(rows, **wanted):
    """Return the first row that fits as a dict, or None; one without new_pixels fits any."""
    for name, value in wanted.items():
        rows = rows[(rows[name] == value).fillna(name == 'new_pixels')]
    return None if rows.empty else rows.iloc[0].dropna().to_dict()


def test_seeds_are_averaged_and_do_not_count_as_episodes():
    first, second = scores(0.02), scores(0.04, seed=1)
    row = find(rows_of(made_run('fix', first), made_run('fix', second, seed=1)),
               method='fix', metric='min_l1')
    both = [np.mean(first['min_l1']), np.mean(second['min_l1'])]
    assert row['value'] == pytest.approx(np.mean(both), abs=1e-6)
    assert (row['n'], row['seeds']) == (EPISODES, 2)
    assert list(map(float, row['by_seed'].split())) == pytest.approx(both, rel=1e-5)
    assert row['runs'] == 'push2-bidirectional-fix-s0 push2-bidirectional-fix-s1'


def test_gains_are_paired_by_episode():
    # Errors differ a lot between episodes, but one method's are always half of the other's.
    errors = np.random.default_rng(0).uniform(0.001, 0.1, EPISODES)
    rows = rows_of(made_run('fix', scores(errors)), made_run('min', scores(errors / 2)))
    gain = find(rows, method='min', metric='gain_over_fix')
    assert (gain['value'], gain['ci_low'], gain['ci_high']) == pytest.approx((0.5,) * 3)
    assert gain['baseline'] == 'fix'
    error = find(rows, method='min', metric='min_l1')
    assert error['ci_high'] - error['ci_low'] > 0.005


def test_the_hull_is_what_choosing_between_two_points_gives():
    points = [(0.0, 1.0), (4.0, 1.0), (2.0, 5.0), (2.0, 0.0)]
    at = np.array([-0.1, 0.0, 1.0, 2.0, 4.0, 4.1])
    np.testing.assert_allclose(lower_hull(at, points), [np.nan, 1, 0.5, 0, 1, np.nan])


def test_forward_gains_compare_at_the_same_match_step():
    def forward(method, l1, at):
        return made_run(method, scores([l1] * EPISODES, [at] * EPISODES, frames=101),
                        task='grasp', mode='forward')
    rows = rows_of(forward('fix0.25', 0.02, 0.2), forward('fix1.00', 0.04, 0.6),
                   forward('genmin4', 0.015, 0.4), forward('genmin0.5', 0.03, 0.8))
    metric = 'gain_over_fix_at_match_step'
    assert find(rows, method='genmin4', metric=metric)['value'] == pytest.approx(0.5)
    assert not find(rows, method='genmin0.5', metric=metric)


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
    path.write_text('{"name": "x"}')
    with pytest.raises(ConfigError, match='lacks .*evaluation'):
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


def test_grids_show_each_method_that_has_weights(tmp_path):
    runs = [made_run('fix', scores(0.02)), made_run('genmin', scores(0.01)),
            made_run('genmin-vae-gan', scores(0.01)),
            made_run('genmin4', scores(0.01), mode='forward')]
    data_hash = open_recordings([str(SAMPLE)]).data_hash
    there = tmp_path / 'push2-bidirectional.png'
    there.write_bytes(b'of all')

    def write(*chosen):
        for run in chosen:
            run['config'] = {'recordings': [str(SAMPLE)], 'test_fraction': 0.5}
            run['data'] = run['data'] | {'hash': data_hash}
            torch.manual_seed(0)
            config = PredictorConfig(base_width=4,
                                     num_context=1 if run['mode'] == 'forward' else 2,
                                     latent_size=8 if 'vae' in run['method'] else 0)
            save_weights(tmp_path / 'weights' / run['name'] / 'predictor.safetensors',
                         PredictorNetwork(config), 'predictor', asdict(config), {})
        write_grids(tmp_path, runs, tmp_path / 'weights')

    write(runs[0])
    assert there.read_bytes() == b'of all', 'a picture that shows more stays'
    write(*runs)
    sizes = {path.stem: cv2.imread(str(path)).shape[1] for path in tmp_path.glob('*.png')}
    columns = {name: (width + 2) // 130 for name, width in sizes.items()}
    assert columns == {'push2-bidirectional': 2 + 3 + 1, 'push2-forward': 1 + 1 + 1}
