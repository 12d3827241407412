# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the results page and of the pictures in it."""

from dataclasses import asdict
from pathlib import Path
import re

import cv2
from experiments.paper.pictures import _contrast, _sampling, draw, write_grids
from experiments.paper.results import write_results
from experiments.paper.runs import paper_runs
from made_runs import made_run, save_runs, scores
import numpy as np
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.recording.cache import open_recordings
from tap_ros.training.weights import save_weights
import torch

OURS, GENMIN, FIX = 'genmin-wo-gan+progress+skips', 'genmin-wo-gan+skips', 'fix-wo-gan+skips'
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


def test_other_seeds_of_a_main_row_are_missing(tmp_path):
    page = page_of(tmp_path, made_run(GENMIN, scores(0.01), task='grasp'))
    missing = page.split('## Missing')[1]
    assert f'grasp-bidirectional-{GENMIN}-s0' not in missing.split('All runs')[0]
    for seed in (1, 2):
        assert f'grasp-bidirectional-{GENMIN}-s{seed}' in missing


def test_match_steps_are_called_equal_only_if_they_are(tmp_path):
    page = page_of(tmp_path, made_run('fix', scores(0.02, 0.5)),
                   made_run('min', scores(0.01, 0.9)),
                   made_run('genmin', scores(0.01, 0.52)))
    assert line_of(page, '| Pushing two objects | min |').split(' | ')[6] == 'no'
    assert line_of(page, '| Pushing two objects | genmin |').split(' | ')[6] == 'yes'


def claim(page, start):
    """Return the cells of a claim: claim, paper, target, here, met, where."""
    return [cell.strip() for cell in line_of(page, f'| {start}').strip('|').split('|')]


def test_claims_follow_the_numbers(tmp_path):
    late = {'task': 'push2_late', 'new_pixels': False}
    found = page_of(tmp_path / 'a', made_run(
        OURS, scores(0.01, bottleneck=[1.0] * 36 + [9.0] * 4), **late), made_run(
            FIX, scores(0.01, bottleneck=[1.0] * 8 + [9.0] * 32), **late))
    text = 'the same, the first object home late: '
    ours, fix = claim(found, text + '`genmin'), claim(found, text + '`fix`')
    assert ours[3].startswith('90% (') and ours[2:5:2] == ['at least 85%', 'yes']
    assert fix[3].startswith('20% (') and fix[2:5:2] == ['at most 10%', 'no']
    assert claim(found, 'from the start alone')[4] == '*not run*'


def test_a_gain_is_a_claim_of_each_network(tmp_path):
    page = page_of(tmp_path, *(made_run(method, scores(l1), task='grasp') for method, l1 in (
        ('fix', 0.04), ('genmin', 0.02), (FIX, 0.04), (GENMIN, 0.036))))
    start = '`genmin` has a lower error than `fix`: grasping, '
    theirs, ours = (claim(page, start + name) for name in ("the paper's", 'our'))
    assert theirs[1] == '21.0%' and theirs[3].startswith('50%') and theirs[4] == 'yes'
    assert ours[1] == '' and ours[3].startswith('10%') and ours[4] == 'no'


def test_the_best_of_100_is_a_claim_about_intervals(tmp_path):
    def page(folder, best):
        return page_of(
            tmp_path / folder, made_run('genmin', scores(0.01), task='pick_place'),
            made_run('genmin-vae', scores(0.02), task='pick_place',
                     best_of_100={'min_l1': [best] * 40}))
    start = 'the best of 100 samples beats the best method without samples: pick'
    assert claim(page('a', 0.001), start)[4] == 'yes'
    assert claim(page('b', 0.0099), start)[4] == 'no'
    less = page_of(  # on the same episodes, each of which has an error of its own
        tmp_path / 'c', made_run('genmin', scores(0.01), task='pick_place'),
        made_run('genmin-vae', scores(0.02), task='pick_place', best_of_100=scores(0.0095)))
    assert claim(less, start)[3].endswith('; 5% (5% to 5%) below')
    assert claim(less, start)[4] == 'paired only'
    longer = page_of(  # was trained for more steps than the samples' method
        tmp_path / 'd', made_run('genmin', scores(0.01), task='pick_place'),
        made_run('genmin-wo-gan+skips+long', scores(0.0001), task='pick_place'),
        made_run('genmin-vae', scores(0.02), task='pick_place', best_of_100=scores(0.0095)))
    assert claim(longer, start) == claim(less, start)


def test_recursion_is_a_claim_about_the_place(tmp_path):
    def page(folder, first):
        shown = {'hand': [1.0] * 40, 'objects': [1.0] * 40}
        return claim(page_of(tmp_path / folder, made_run(
            OURS, scores(0.01), task='pick_place',
            recursion=[{'way': first, **shown}, {'way': [0.0] * 40, **shown}])), 'recursion of ')
    assert page('a', [0.9] * 40)[3:5] == ['100% (100% to 100%)', 'yes']
    assert page('b', [0.5] * 40)[3:5] == ['r = 1 is never the place', 'no']


def test_fig_4_is_a_claim_about_six_betas(tmp_path):
    def forward(method, l1, at):
        return made_run(f'{method}-wo-gan+skips', scores([l1] * 40, [at] * 40, frames=101),
                        task='grasp', mode='forward')
    fixed = [forward('fix0.25', 0.02, 0.2), forward('fix0.50', 0.04, 0.4),
             forward('fix0.75', 0.04, 0.5), forward('fix1.00', 0.04, 0.6)]
    betas = ['genmin30', 'genmin10', 'genmin7', 'genmin4', 'genmin2', 'genmin0.5']
    page = page_of(tmp_path, *fixed, *(
        forward(beta, l1, at) for beta, l1, at in zip(
            betas, [0.01, 0.01, 0.01, 0.01, 0.05, 0.01], [0.3, 0.3, 0.3, 0.3, 0.3, 0.9])))
    cells = claim(page, 'from the start alone')
    assert cells[3:5] == ['lower for 4 of 6, higher for 1, 1 beyond all fixed times', 'yes']
    page = page_of(tmp_path / 'alone', *(forward(beta, 0.01, 0.3) for beta in betas))
    assert claim(page, 'from the start alone')[4] == '*not run*', 'without fix'


def test_settings_that_differ_are_named(tmp_path):
    plain, ours = made_run('genmin', scores(0.02)), made_run('genmin+progress', scores(0.01))
    plain['config']['margin'], ours['config']['margin'] = 0, 3
    others = [made_run(method, scores(0.02), task='grasp') for method in ('fix', 'min', 'genmin')]
    for run in (plain, ours):
        run['config']['colour'] = True
    for run in others:
        run['config'] |= {'margin': 0, 'colour': False}
    page = page_of(tmp_path, plain, ours, *others)
    assert '| `colour` | False | all others |\n|  | True | all of push2 |' in page
    assert '| `margin` | 0 | all others |\n|  | 3 | push2: genmin+progress |' in page
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
        made_run('fix', placed, new_pixels=False, task='push2_early'),
        made_run('fix', placed, new_pixels=False, task='push2_mixed'),
        made_run('fix0.50', scores(0.02), task='grasp', mode='forward'),
        made_run('genmin4', scores(0.01), task='grasp', mode='forward'))
    shown = set(re.findall(r'\]\(([\w+.-]+\.png)\)', page))
    assert shown == {f'{name}.png' for name in (
        'forward_scatter', 'bottleneck_curve', 'gains', 'match_steps', 'timing')}
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
    def chosen(task, mode, new_pixels):
        return _contrast([run.label for run in paper_runs('small')
                          if (run.task, run.mode, run.new_pixels) == (task, mode, new_pixels)])

    for task in ('grasp', 'pick_place', 'push2', 'push3', 'stack2'):
        assert chosen(task, 'bidirectional', True) == [FIX, GENMIN, OURS]
    assert chosen('push2', 'bidirectional', False) == [FIX, GENMIN, OURS]
    assert chosen('grasp', 'forward', True) == ['fix0.50-wo-gan+skips', 'genmin4-wo-gan+skips']


def test_samples_are_of_the_method_whose_best_is_lowest():
    runs = [{'method': method, 'evaluation': evaluation} for method, evaluation in (
        (FIX, {}), ('genmin-vae-gan', {}),
        ('genmin-vae+skips', {'best_of_100': {'min_l1': [0.01, 0.03]}}),
        ('genmin-vae+skips+frame', {'best_of_100': {'min_l1': [0.018, 0.018]}}))]
    assert _sampling(runs) == ['genmin-vae+skips+frame']
    assert _sampling(runs[:3]) == ['genmin-vae+skips']
    assert _sampling(runs[:2]) == ['genmin-vae-gan']
    assert _sampling(runs[:1]) == []


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


def test_a_picture_needs_only_the_weights_that_it_shows_of_whichever_seed(tmp_path):
    pieces = f'{OURS}+pieces'
    runs = [made_run(method, scores(0.02), seed=seed)
            for method in (FIX, GENMIN, OURS, pieces, 'min-wo-gan+skips') for seed in (0, 1)]
    data_hash = open_recordings([str(SAMPLE)]).data_hash
    names = ('', '-masks', '-recursion')
    there = [tmp_path / f'push2-bidirectional{name}.png' for name in names]
    for path in there:
        path.write_bytes(b'before')
    for run in runs:
        run['config'] = {'recordings': [str(SAMPLE)], 'test_fraction': 0.5}
        run['data'] = run['data'] | {'hash': data_hash}
        if run['seed'] == 1 and not run['method'].startswith('min'):
            weights_for(tmp_path / 'weights', run)
    write_grids(tmp_path, runs, tmp_path / 'weights')
    # The first would show min, too.
    assert [path.read_bytes() == b'before' for path in there] == [True, False, False]
    assert (cv2.imread(str(there[2])).shape[1] + 2) // 130 == 2 + 2


def test_headings_stand_above_the_panels():
    panel = np.zeros((16, 16, 3), np.uint8)
    picture = draw('title', [[('a', None, 2)], [('b', None, 1), ('c', None, 1)]], [[panel] * 2])
    assert (picture[-32:, :32] == 0).all() and (picture[-32:, 34:] == 0).all()
    assert picture.shape[1] == 2 * 32 + 2
    assert (picture[:-32] < 128).any()
