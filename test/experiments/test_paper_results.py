# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the numbers that are made from the scores of runs."""

from dataclasses import asdict
from pathlib import Path

import cv2
from experiments.paper.names import best_of_name, method_order
from experiments.paper.pictures import write_grids
from experiments.paper.results import load_runs, on_same_episodes, write_results
from experiments.paper.rows import (
    as_frame,
    COLUMNS,
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


def test_every_row_has_all_keys_and_lies_in_its_interval():
    rows = make_rows(group_runs(
        [made_run('fix', scores(0.02)), made_run('genmin', scores(0.01, seed=1))]))
    assert {row['method'] for row in rows} == {'fix', 'genmin', 'copy-start', 'copy-goal'}
    for row in rows:
        assert KEYS <= set(row) <= set(COLUMNS)
        assert row['ci_low'] <= row['value'] <= row['ci_high']
        assert row['n'] == EPISODES


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


def test_models_with_and_without_new_pixels_are_kept_apart():
    rows = rows_of(made_run('fix', scores(0.02)),
                   made_run('genmin', scores(0.01), new_pixels=False))
    assert find(rows, method='genmin', new_pixels=False, metric='min_l1')
    assert not find(rows, method='genmin', new_pixels=True, metric='min_l1')
    assert not find(rows, method='genmin', metric='gain_over_fix')


def test_bottlenecks_are_counted_where_they_are_defined():
    rows = rows_of(made_run('genmin', scores(
        0.01, bottleneck=[None] * 20 + [1.0] * 5 + [2.0] * 5 + [9.5] * 10), new_pixels=False))
    shares = [find(rows, method='genmin', metric=f'bottleneck_frequency_{n}px')
              for n in range(11)]
    assert [row['value'] for row in shares] == [0, .25, .5, .5, .5, .5, .5, .5, .5, .5, 1]
    assert shares[0]['n'] == 20
    assert not find(rows, method='copy-start', metric='bottleneck_frequency_2px')


def test_an_object_that_is_left_out_is_no_visible_bottleneck():
    rows = rows_of(made_run('genmin', scores(
        0.01, bottleneck=[1.0] * 20 + [9.0] * 20, mass=[0.1] * 10 + [0.5] * 30),
        new_pixels=False))
    shares = [find(rows, method='genmin', metric=metric + 'bottleneck_frequency_2px')['value']
              for metric in ('', 'visible_')]
    assert shares == [0.5, 0.25]


def test_variants_of_a_method_have_names_of_their_own(tmp_path):
    run = made_run('genmin', scores(0.01)) | {'variant': '+skips'}
    save_runs(tmp_path, [run])
    assert [run['method'] for run in load_runs(tmp_path / 'runs')] == ['genmin+skips']
    order = ['genmin', 'genmin+progress', 'fix-wo-gan+skips', 'genmin+skips',
             'genmin+skips+margin', 'genmin+progress+skips']
    shuffled = [order[i] for i in (2, 0, 3, 5, 1, 4)]
    assert sorted(shuffled, key=method_order) == order


def test_copying_is_seen_as_beside_an_input():
    rows = rows_of(made_run('min', scores(0.01, [0.03] * 20 + [0.98] * 10 + [0.5] * 10)))
    assert find(rows, method='min', metric='match_beside_input')['value'] == 0.75
    assert find(rows, method='copy-goal', metric='match_beside_input')['value'] > 0.7
    # In forward prediction the last frame is no input.
    rows = rows_of(made_run('fix1.00', scores(0.01, [0.03] * 20 + [0.98] * 20), task='grasp',
                            mode='forward'))
    assert find(rows, method='fix1.00', metric='match_beside_input')['value'] == 0.5


def test_the_papers_best_of_100_is_of_the_model_with_gan():
    assert best_of_name('genmin-vae-gan') == 'genmin-vae-best-of-100'
    assert best_of_name('genmin-vae') == 'genmin-vae-wo-gan-best-of-100'
    assert best_of_name('genmin-vae-gan+relative') == 'genmin-vae-best-of-100+relative'
    best = {'min_l1': [0.001] * EPISODES}
    rows = rows_of(made_run('genmin-vae-gan', scores(0.03), best_of_100=best,
                            sample_spread=[0.25] * EPISODES, sample_spread_px=[None] * EPISODES))
    row = find(rows, method='genmin-vae-best-of-100', metric='min_l1')
    assert (row['value'], row['of']) == (0.001, 'genmin-vae-gan')
    assert find(rows, method='genmin-vae-gan', metric='sample_spread')['value'] == 0.25
    assert not find(rows, metric='sample_spread_px')


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


def test_between_start_and_goal_copying_is_fixed_time_prediction_too():
    def constant(l1, at):
        return scores([l1] * EPISODES, [at] * EPISODES, frames=101)

    def run(method, l1, at):
        return made_run(method, constant(l1, at), **{
            'copy-start': constant(0.02, 0.1), 'copy-goal': constant(0.02, 0.9)})

    metric = 'gain_over_fix_at_match_step'
    # On the line between fix (0.5) and copying the goal (0.9).
    rows = rows_of(run('fix', 0.04, 0.5), run('genmin', 0.01, 0.7))
    row = find(rows, method='genmin', metric=metric)
    assert row['value'] == pytest.approx(1 - 0.01 / 0.02)
    rows = rows_of(run('fix', 0.01, 0.5), run('genmin', 0.01, 0.7))
    assert find(rows, method='genmin', metric=metric)['value'] == pytest.approx(1 - 0.01 / 0.015)
    assert not find(rows, method='copy-goal', metric=metric)
    assert not find(rows_of(run('genmin', 0.01, 0.7)), metric=metric)  # without any fix


def test_a_method_is_compared_with_fix_of_its_network():
    rows = rows_of(*(made_run(method, scores(l1)) for method, l1 in (
        ('fix', 0.04), ('fix-wo-gan+skips', 0.02), ('genmin', 0.02), ('genmin-wo-gan', 0.01),
        ('genmin-wo-gan+skips', 0.01), ('genmin-wo-gan+skips+margin', 0.015))))
    for method, baseline, gain in (
            ('genmin', 'fix', 0.5), ('genmin-wo-gan', 'fix', 0.75),
            ('genmin-wo-gan+skips', 'fix-wo-gan+skips', 0.5),
            ('genmin-wo-gan+skips+margin', 'fix-wo-gan+skips', 0.25)):
        row = find(rows, method=method, metric='gain_over_fix')
        assert row['baseline'] == baseline and row['value'] == pytest.approx(gain, abs=0.01)
        row = find(rows, method=method, metric='gain_over_fix_at_match_step')
        assert row is None or baseline in row['baseline'].split()


def test_other_looks_have_rows_of_their_own():
    placed = scores(0.01, bottleneck=[1.0] * 10 + [9.0] * 30)
    copied = scores(0.01, bottleneck=[9.0] * 40)
    shifted = {'arm_elsewhere': {'prediction': scores(0.02, bottleneck=[1.0] * 40),
                                 'copy-goal': copied},
               'push2_other_light': {'prediction': scores(0.03, bottleneck=[9.0] * 40),
                                     'copy-goal': copied}}
    rows = rows_of(made_run('genmin', placed, new_pixels=False, shifted=shifted))
    assert [find(rows, task=task, method='genmin', metric='bottleneck_frequency_2px')['value']
            for task in ('push2', 'push2_arm_elsewhere', 'push2_other_light')] == [0.25, 1, 0]
    assert find(rows, task='push2_other_light', method='copy-goal', metric='min_l1')


def levels(first, second, hand=1.0):
    """Invent the scores of two levels of recursion from the objects' shares of their way."""
    return {'recursion': [
        {'way': way, 'hand': [hand] * EPISODES, 'objects': [1.0] * EPISODES}
        for way in (first, second)]}


def test_the_pick_is_counted_where_the_place_was_found():
    first = [0.9] * 20 + [0.5] * 10 + [None] * 10
    second = [0.1] * 15 + [0.6] * 5 + [0.0] * 20
    rows = rows_of(made_run('genmin', scores(0.01), task='pick_place', **levels(first, second)))

    def value(metric):
        row = find(rows, method='genmin', metric=metric)
        assert row['ci_low'] <= row['value'] <= row['ci_high']
        return row['value']

    assert value('place') == pytest.approx(20 / 30, abs=1e-6)
    assert value('pick_after_place') == value('pick_after_place_shown') == 0.75
    assert find(rows, method='genmin', metric='pick_after_place')['n'] == 20
    unknown = levels(first, second)
    unknown['recursion'][1]['hand'][:10] = [None] * 10
    rows = rows_of(made_run('genmin', scores(0.01), task='pick_place', **unknown))
    assert value('pick_after_place_shown') == 0.5 and value('pick_after_place') == 0.75
    rows = rows_of(made_run('genmin', scores(0.01), task='pick_place',
                            **levels(first, second, hand=0.4)))
    assert value('pick_after_place') == 0.75 and value('pick_after_place_shown') == 0
    rows = rows_of(made_run('genmin', scores(0.01), task='pick_place',
                            **levels([0.5] * EPISODES, second)))
    assert value('place') == 0 and not find(rows, metric='pick_after_place')


def test_what_predictions_show_is_counted_where_it_is_known():
    shown = scores(0.01) | {'hand': [0.9] * 30 + [None] * 10,
                            'objects': [0.9] * 10 + [0.1] * 20 + [0.9] * 10}
    row = find(rows_of(made_run('genmin', shown, task='grasp')), method='genmin',
               metric='shows_both')
    assert (row['value'], row['n']) == (pytest.approx(1 / 3, abs=1e-6), 30)


def test_methods_stand_in_the_order_of_the_paper():
    order = ['copy-start', 'copy-goal', 'fix', 'fix0.75', 'min', 'genmin30', 'genmin', 'genmin2',
             'genmin+relative', 'genmin-vae-gan', 'genmin-vae-best-of-100']
    assert sorted(order[4:] + order[:4], key=method_order) == order


def test_numbers_of_other_recordings_are_left_out():
    runs = [made_run('fix', scores(0.02)), made_run('min', scores(0.02)),
            made_run('genmin', scores(0.01)), made_run('genmin4', scores(0.01), mode='forward')]
    runs[1]['data']['hash'] = 'of another machine'
    runs[2]['evaluation']['copy-start']['min_l1'][7] += 1e-5  # another episode
    kept, left_out = on_same_episodes(runs)
    assert [run['method'] for run in kept] == ['fix', 'min', 'genmin4']
    assert [run['method'] for run in left_out] == ['genmin']


def test_a_run_trained_for_recursion_is_not_averaged_with_the_plain_one(tmp_path):
    recursive = made_run('genmin', scores(0.05), task='pick_place')
    recursive |= {'recursion': 2, 'name': 'pick_place-bidirectional-genmin-r2-s0'}
    save_runs(tmp_path, [made_run('genmin', scores(0.02), task='pick_place'), recursive])
    methods = {run['method'] for run in load_runs(tmp_path / 'runs')}
    assert methods == {'genmin', 'genmin-r2'}


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
