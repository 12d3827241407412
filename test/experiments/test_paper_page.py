# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the results page and of the pictures in it."""

from dataclasses import asdict
from pathlib import Path
import re
from types import SimpleNamespace

import cv2
from experiments.paper.pictures import _contrast, draw, write_grids
from experiments.paper.results import write_results
from experiments.paper.runs import paper_runs
from made_runs import made_run, save_runs, scores
import numpy as np
from tap_ros.learning.weights import save_weights
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.recording.cache import open_recordings
import torch

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'


def page_of(folder, *runs, findings=None):
    save_runs(folder, runs)
    if findings:
        (folder / 'findings.md').write_text(findings)
    write_results(folder, pictures=False)
    return (folder / 'README.md').read_text()


def line_of(page, start):
    return next(line for line in page.splitlines() if line.startswith(start))


def test_a_number_stands_beside_the_papers(tmp_path):
    page = page_of(tmp_path, made_run('min', scores([0.0123] * 40), task='grasp'))
    assert re.search(r'\| min \| 0\.0123 .*\| 0\.0104 \|', line_of(page, '| min |'))


def test_what_is_missing_is_seen_with_its_command(tmp_path):
    page = page_of(tmp_path, made_run('min', scores(0.01), task='grasp'))
    assert '*not run*' in line_of(page, '| genmin |')
    missing = page.split('## Missing')[1]
    for run in paper_runs('small'):
        if run.name != 'grasp-bidirectional-min-s0':
            assert run.command in missing
        else:
            assert run.command + '\n' not in missing
    assert f'Scale small: 1 of the {len(paper_runs("small"))} ' in page


def test_match_steps_are_called_equal_only_if_they_are(tmp_path):
    page = page_of(tmp_path, made_run('fix', scores(0.02, 0.5)),
                   made_run('min', scores(0.01, 0.9)),
                   made_run('genmin', scores(0.01, 0.52)))
    assert line_of(page, '| Pushing two objects | min |').split(' | ')[6] == 'no'
    assert line_of(page, '| Pushing two objects | genmin |').split(' | ')[6] == 'yes'


def test_sentences_follow_the_numbers(tmp_path):
    found = page_of(tmp_path / 'a', made_run('genmin+relative', scores(
        0.01, bottleneck=[1.0] * 30 + [9.0] * 10), new_pixels=False))
    assert 'genmin+relative with 75%' in found and 'at least the 58%' in found
    found = page_of(tmp_path / 'b', made_run('genmin+relative', scores(
        0.01, bottleneck=[1.0] * 10 + [9.0] * 30), new_pixels=False))
    assert 'less than the 58%' in found


def test_settings_that_differ_are_named(tmp_path):
    plain, ours = made_run('genmin', scores(0.02)), made_run('genmin+relative', scores(0.01))
    plain['config']['margin'], ours['config']['margin'] = 0, 3
    page = page_of(tmp_path, plain, ours)
    assert '| `margin` | 0 | all others |\n|  | 3 | genmin+relative |' in page
    assert '`learning_rate`' not in page


def test_what_a_person_wrote_is_in_the_page(tmp_path):
    text = '## What we found\n\nIt *works*.'
    page = page_of(tmp_path, made_run('fix', scores(0.02)), findings=text + '\n')
    assert text in page


def test_every_picture_in_the_page_is_there(tmp_path):
    warp = {'new_pixels': False, 'task': 'push2'}
    placed = scores(0.01, bottleneck=[1.0] * 40)
    page = page_of(
        tmp_path, made_run('fix', placed, **warp), made_run('genmin', placed, **warp),
        made_run('fix', scores(0.02)), made_run('min', scores(0.01)),
        made_run('fix0.50', scores(0.02), task='grasp', mode='forward'),
        made_run('genmin4', scores(0.01), task='grasp', mode='forward'))
    shown = set(re.findall(r'\]\(([\w+.-]+\.png)\)', page))
    assert shown == {'forward_scatter.png', 'bottleneck_curve.png', 'gains.png', 'match_steps.png'}
    assert shown == {path.name for path in tmp_path.glob('*.png')}


def weights_for(folder, run, **config):
    torch.manual_seed(0)
    config = PredictorConfig(base_width=4, **config)
    save_weights(folder / run['name'] / 'predictor.safetensors', Predictor(config), 'predictor',
                 asdict(config), {})


def test_grids_show_each_method_that_has_weights(tmp_path):
    runs = [made_run('fix', scores(0.02)), made_run('genmin', scores(0.01)),
            made_run('genmin-vae-gan', scores(0.01)),
            made_run('genmin4', scores(0.01), mode='forward')]
    data_hash = open_recordings([str(SAMPLE)]).data_hash
    for run in runs:
        run['config'] = {'recordings': [str(SAMPLE)], 'test_fraction': 0.5}
        run['data'] = run['data'] | {'hash': data_hash}
        weights_for(tmp_path / 'weights', run, num_context=1 if run['mode'] == 'forward' else 2,
                    latent_size=8 if 'vae' in run['method'] else 0)
    write_grids(tmp_path, runs, tmp_path / 'weights')
    sizes = {path.stem: cv2.imread(str(path)).shape[:2] for path in tmp_path.glob('*.png')}
    columns = {name: (width + 2) // 130 for name, (_, width) in sizes.items()}
    assert columns == {
        'push2-bidirectional': 2 + 3 + 1, 'push2-bidirectional-masks': 2 + 2 * 4,
        'push2-bidirectional-recursion': 2 + 2 * 2, 'push2-bidirectional-samples': 2 + 6,
        'push2-forward': 1 + 1 + 1}


def test_masks_show_a_form_of_ours_that_finds_bottlenecks():
    names = ['fix', 'fix+root', 'genmin', 'genmin+changed', 'genmin+relative']
    shown = [SimpleNamespace(method=name) for name in names]
    assert [one.method for one in _contrast(shown)] == ['fix', 'genmin', 'genmin+relative']
    assert [one.method for one in _contrast(shown[:4])] == ['fix', 'genmin', 'genmin+changed']
    assert [one.method for one in _contrast(shown[1:3])] == ['genmin']


def test_a_picture_that_shows_more_is_not_replaced(tmp_path):
    runs = [made_run('fix', scores(0.02)), made_run('genmin', scores(0.01))]
    data_hash = open_recordings([str(SAMPLE)]).data_hash
    for run in runs:
        run['config'] = {'recordings': [str(SAMPLE)], 'test_fraction': 0.5}
        run['data'] = run['data'] | {'hash': data_hash}
    weights_for(tmp_path / 'weights', runs[0])
    there = tmp_path / 'push2-bidirectional.png'
    there.write_bytes(b'of both')
    write_grids(tmp_path, runs, tmp_path / 'weights')
    assert there.read_bytes() == b'of both'
    weights_for(tmp_path / 'weights', runs[1])
    write_grids(tmp_path, runs, tmp_path / 'weights')
    assert there.read_bytes() != b'of both'


def test_headings_stand_above_the_panels():
    panel = np.zeros((16, 16, 3), np.uint8)
    picture = draw('title', [[('a', None, 2)], [('b', None, 1), ('c', None, 1)]], [[panel] * 2])
    assert (picture[-32:, :32] == 0).all() and (picture[-32:, 34:] == 0).all()
    assert picture.shape[1] == 2 * 32 + 2
    assert (picture[:-32] < 128).any()
