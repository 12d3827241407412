# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the pages say was measured, and what they cite stands in the paper."""

from io import StringIO
import json
import re

from experiments import few, fullsize, tables, tracking
from experiments.paper import published
from experiments.paper import rows as rows_of_scores
from experiments.paper.results import load_runs, on_same_episodes
from experiments.paper.rows import as_frame, group_runs, make_rows
from experiments.real import WAYS
from experiments.tables import (
    find,
    FIX,
    LATE,
    OURS,
    PLANNING,
    PREDICTION,
    RELATIVE,
    RESULTS,
    STACKING,
)
from experiments.worlds import command
import numpy as np
from pandas import DataFrame, read_csv
import pytest
from tap_ros.evaluation.intervals import Interval, share_interval

ROOT = RESULTS.parents[1]
README = (ROOT / 'README.md').read_text()
GENMIN = OURS.format('')
FOUND = {'metric': 'bottleneck_frequency_2px', 'new_pixels': False, 'mode': 'bidirectional'}
GAIN = {'metric': 'gain_over_fix', 'new_pixels': True, 'mode': 'bidirectional'}


@pytest.mark.parametrize('page', ['prediction', 'planning', 'stacking', 'speed'])
def test_tables_are_made_from_the_data(page):
    assert tables.filled(page) == tables.page_path(page).read_text()


def test_pages_are_made_from_the_data():
    def rows(name):
        return json.loads((RESULTS / f'{name}.json').read_text())

    for name, page in (
            ('few', few.page(rows('few'))), ('fullsize', fullsize.page(rows('fullsize'))),
            ('worlds', command.page(rows('worlds'))),
            ('tracking', tracking.page(rows('tracking'), tracking.loop(RESULTS / 'tracking')))):
        assert page == (RESULTS / f'{name}.md').read_text(), name


def test_numbers_of_predictions_are_made_from_the_scores(monkeypatch):
    runs, left_out = on_same_episodes(load_runs(RESULTS / 'runs'))
    assert not left_out
    # With intervals of one task: those of all take ten times as long.
    made = as_frame(make_rows(group_runs([run for run in runs if run['task'] == 'stack2'])))
    lines = (RESULTS / PREDICTION).read_text().splitlines()
    assert made.to_csv(index=False).splitlines() == [
        line for line in lines if line.startswith(('task,', 'stack2,'))]
    monkeypatch.setattr(rows_of_scores, 'bootstrap', lambda statistic, *arrays, **_: Interval(
        *3 * [float(statistic(*arrays))]))
    ends = ['ci_low', 'ci_high']
    made, written = (
        set(map(str, table.drop(columns=ends).to_dict('records'))) for table in (
            read_csv(StringIO(as_frame(make_rows(group_runs(runs))).to_csv(index=False))),
            read_csv(RESULTS / PREDICTION)))
    assert written <= made and len(made - written) < 30  # gains that their intervals leave out


def values_of(file):
    """Return every value and interval of a file of the results, rounded in all ways, as texts."""
    rows = tables.read(RESULTS / file)[['value', 'ci_low', 'ci_high']].dropna()
    return {
        tuple(f'{round(factor * bound, digits) + 0.0:.{digits}f}' for bound in bounds)
        for value, low, high in rows.drop_duplicates().itertuples(index=False)
        for sign, bounds in ((1, (value, low, high)), (-1, (value, high, low)))
        for factor in (sign, 100 * sign) for digits in range(3)}


def intervals_in(page):
    """Return every value and interval of a page, as texts."""
    return set(re.findall(
        r'(-?\d+(?:\.\d+)?)[^()\d]{0,60}\((-?\d+(?:\.\d+)?) to \+?(-?\d+(?:\.\d+)?)[,;)]',
        ' '.join(page.read_text().split())))


@pytest.mark.parametrize('page', [f'docs/results/{name}.md' for name in (
    'README', 'prediction', 'planning', 'stacking')])
def test_every_interval_on_a_page_stands_in_the_data(page):
    found = intervals_in(ROOT / page)
    known = set().union(*(intervals_in(RESULTS / f'{name}.md')  # made from their own data
                          for name in ('worlds_loop', 'tracking')))
    wide = json.loads((RESULTS / 'wide.json').read_text())['runs']
    for name, factor, digits in (('min_l1', 1, 4), ('bottleneck_2px', 100, 0)):
        known |= {tuple(f'{factor * bound:.{digits}f}' for bound in (
            run['scores'][name], *run['intervals'][name])) for run in wide}
    missing = found - known.union(*map(values_of, (PREDICTION, PLANNING, LATE, STACKING)))
    assert len(found) >= 4 and not missing


def test_the_sentences_of_the_readme_are_those_of_the_data():
    def planned(task, method):
        return find(RESULTS, PLANNING, task=task, method=method, metric='success_5cm')['value']

    text = ' '.join(README.split())
    assert ('succeeds in {:.0%} of 100 scenes with two objects, and directly in {:.0%}; via a '
            'subgoal at a fixed time it is {:.0%}').format(*(
                planned('order2', method) for method in ('shipped', 'direct', 'fix'))) in text
    late = [find(RESULTS, PREDICTION, task='push2_late', method=method, **FOUND)['value']
            for method in (RELATIVE, FIX)]
    assert 'the time-agnostic loss finds {:.0%} of them and a loss at a fixed time {:.0%}'.format(
        *late) in text
    gain = find(RESULTS, PREDICTION, task='push2', method=GENMIN, **GAIN)['value']
    assert (f"the error is {gain:.0%} below a fixed time's (the paper reports "
            f'{published.GAINS["push2"]:.0%})') in text
    wall = DataFrame(json.loads((RESULTS / 'worlds_loop.json').read_text()))
    ends = wall.groupby('method')['ends'].mean()
    assert ('the predicted subgoals succeed in {:.0%} of {} scenes, and planning directly in '
            '{:.0%}').format(ends['subgoal'], wall['seed'].nunique(), ends['direct']) in text
    assert 'A fixed time has {:.0%}, not significantly less; three trainings'.format(
        ends['fixed time']) in text
    real = json.loads((RESULTS / 'real.json').read_text())['30']
    (error, _, off), (keyframe_error, _, keyframe_off) = (
        np.concatenate(real[way], 1) for way in (WAYS['keyframes'][0], 'most alike keyframes'))
    right = share_interval(off <= 1 + 1e-3)
    assert (f'In {right.value:.0%} ({100 * right.low:.0f} to {100 * right.high:.0f}) of 40 '
            'held-out demonstrations the predicted moment is within 1 s') in text
    assert f'without a network, are right in {np.mean(keyframe_off <= 1 + 1e-3):.0%}' in text
    assert f'have {keyframe_error.sum() / error.sum():.1f} times the error' in text
