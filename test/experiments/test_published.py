# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the pages say was measured, and what they cite stands in the paper."""

import json
import re

from experiments import tables
from experiments.paper import published
from experiments.paper.results import load_runs, on_same_episodes
from experiments.paper.rows import as_frame, group_runs, make_rows
from experiments.tables import (
    find,
    FIX,
    OURS,
    PIECES,
    PLANNING,
    PREDICTION,
    RELATIVE,
    RESULTS,
    STACKING,
)
import pytest

ROOT = RESULTS.parents[1]
README = (ROOT / 'README.md').read_text()
GENMIN = OURS.format('')
FOUND = {'metric': 'bottleneck_frequency_2px', 'new_pixels': False, 'mode': 'bidirectional'}
GAIN = {'metric': 'gain_over_fix', 'new_pixels': True, 'mode': 'bidirectional'}


def test_the_gains_of_the_text_are_those_of_table_1():
    for task, rows in published.TABLE_1.items():
        assert published.GAINS[task] == pytest.approx(
            1 - rows['genmin'][0] / rows['fix'][0], abs=1e-3)
        # Section 4: best of 100 samples is below every method without samples in two tasks.
        best = rows['genmin-vae-best-of-100'][0]
        others = min(row[0] for name, row in rows.items() if 'best' not in name)
        assert (best < others) == (task != 'grasp')


@pytest.mark.parametrize('page', ['prediction', 'planning', 'stacking'])
def test_tables_are_made_from_the_data(page):
    assert tables.filled(page) == (RESULTS / f'{page}.md').read_text()


def test_numbers_of_predictions_are_made_from_the_scores():
    runs, left_out = on_same_episodes(load_runs(RESULTS / 'runs'))
    assert not left_out
    # One task: all take ten times as long.
    made = as_frame(make_rows(group_runs([run for run in runs if run['task'] == 'stack2'])))
    lines = (RESULTS / PREDICTION).read_text().splitlines()
    assert made.to_csv(index=False).splitlines() == [
        line for line in lines if line.startswith(('task,', 'stack2,'))]


def values_of(file):
    """Return every value and interval of a file of the results, rounded in all ways, as texts."""
    rows = tables.read(RESULTS / file)[['value', 'ci_low', 'ci_high']].dropna()
    return {
        tuple(f'{round(factor * bound, digits) + 0.0:.{digits}f}' for bound in bounds)
        for value, low, high in rows.drop_duplicates().itertuples(index=False)
        for sign, bounds in ((1, (value, low, high)), (-1, (value, high, low)))
        for factor in (sign, 100 * sign) for digits in range(3)}


@pytest.mark.parametrize('page', [
    'README.md', 'docs/training.md', *(f'docs/results/{name}.md' for name in (
        'README', 'prediction', 'planning', 'stacking'))])
def test_every_interval_on_a_page_stands_in_the_data(page):
    text = ' '.join((ROOT / page).read_text().split()).partition('## Shipped weights')[0]
    found = set(re.findall(
        r'(-?\d+(?:\.\d+)?)[^()\d]{0,60}\((-?\d+(?:\.\d+)?) to \+?(-?\d+(?:\.\d+)?)[,;)]', text))
    mutants = json.loads((RESULTS / 'mutants.json').read_text())
    known = {(f'{100 * mutants["killed"] / mutants["tried"]:.0f}', '81', '92')}
    missing = found - known.union(*map(values_of, (PREDICTION, PLANNING, STACKING)))
    assert len(found) >= 4 and not missing


def paper_column(title):
    """Return the cells of the README's column of the paper in a row, as numbers."""
    row = next(line for line in README.splitlines() if line.startswith(f'| {title} |'))
    return [float(number) for number in re.findall(r'[\d.]+', row.split('|')[2])]


def test_the_readme_cites_the_paper():
    for title, values in (
            ('bottlenecks at 2 px, pushing without new pixels, usual recordings: `genmin`; `fix`',
             [100 * published.BOTTLENECK_2PX[method] for method in ('genmin', 'fix')]),
            ('error of `genmin` below `fix`: grasping; pick-and-place',
             [100 * published.GAINS[task] for task in ('grasp', 'pick_place')]),
            ('final distance, cm, two objects: direct; via the subgoal',
             [published.TABLE_2['push2', method][0] for method in ('direct', 'genmin')])):
        assert paper_column(title) == pytest.approx(values)


def test_shares_without_an_interval_are_those_of_the_data():
    shares = [find(RESULTS, PREDICTION, task=task, method=method, **FOUND)['value']
              for method, task in ((GENMIN, 'push2'), (FIX, 'push2'), (RELATIVE, 'push2'),
                                   (RELATIVE, 'push2_late'), (FIX, 'push2_late'))]
    assert '| {:.0%}; {:.0%} |'.format(*shares[:2]) in README
    assert '| {:.0%}; {:.0%}; {:.0%} |'.format(*shares[2:]) in README
    pick = [find(RESULTS, PREDICTION, task='pick_place', method=method, new_pixels=True,
                 metric='pick_after_place', mode='bidirectional')['value'] for method in PIECES]
    assert '| {:.0%}; {:.0%} |'.format(*pick[::-1]) in README
    gains = [find(RESULTS, PREDICTION, task=task, method='genmin', **GAIN)['value']
             for task in ('push2', 'pick_place', 'grasp')]
    assert ("With GAN the paper's network gains {:.0%} in pushing, {:.0%} in pick-and-place, "
            '{:.0%} in grasping').format(*gains) in ' '.join(README.split())
