# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's numbers agree with each other, and with what the pages cite."""

import json
from pathlib import Path
import re

from experiments.paper import published
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / 'README.md').read_text()


@pytest.mark.parametrize('task', published.TABLE_1)
def test_the_gains_of_the_text_are_those_of_table_1(task):
    rows = published.TABLE_1[task]
    assert published.GAINS[task] == pytest.approx(
        1 - rows['genmin'][0] / rows['fix'][0], abs=1e-3)
    # Section 4: best of 100 samples is below every method without samples in two tasks.
    best = rows['genmin-vae-best-of-100'][0]
    others = min(row[0] for name, row in rows.items() if 'best' not in name)
    assert (best < others) == (task != 'grasp')


def paper_column(page, title):
    """Return the cells of a table's column in the row that begins so, as numbers."""
    row = next(line for line in page.splitlines() if line.startswith(f'| {title} |'))
    return [float(number) for number in re.findall(r'[\d.]+', row.split('|')[2])]


@pytest.mark.parametrize('title, value', [
    ('bottlenecks at 2 px, pushing without new pixels, usual recordings: `genmin`; `fix`',
     [100 * published.BOTTLENECK_2PX[method] for method in ('genmin', 'fix')]),
    ('error of `genmin` below `fix`: grasping; pick-and-place',
     [100 * published.GAINS[task] for task in ('grasp', 'pick_place')]),
    ('the same, pushing; at the same match-step', [100 * published.GAINS['push2']]),
    ('final distance, cm, two objects: direct; via the subgoal',
     [published.TABLE_2['push2', method][0] for method in ('direct', 'genmin')])])
def test_the_readme_cites_the_paper(title, value):
    assert paper_column(README, title) == pytest.approx(np.atleast_1d(value))


def measured(file, **wanted):
    """Return value, low and high of a row of the results."""
    rows = json.loads((ROOT / 'docs' / 'results' / file).read_text())
    row, = (row for row in rows if wanted.items() <= {'compares': None, **row}.items())
    return [row[name] for name in ('value', 'ci_low', 'ci_high')]


def text(page):
    """Return a page of the documentation in one line."""
    return ' '.join((ROOT / 'docs' / page).read_text().split())


GENMIN, FIX = ({'mode': 'bidirectional', 'method': f'{name}-wo-gan+skips'}
               for name in ('genmin', 'fix'))
RELATIVE = {**GENMIN, 'method': 'genmin-wo-gan+relative+skips'}
PIECES, WHOLE = ({**GENMIN, 'method': f'genmin-wo-gan+progress+skips{pieces}',
                  'task': 'pick_place'} for pieces in ('+pieces', ''))
BEST = [{**GENMIN, 'method': f'genmin-vae-wo-gan-best-of-100+skips+{form}', 'task': task,
         'metric': 'gain_over_deterministic'}
        for task, form in (('pick_place', 'narrow'), ('push2', 'frame'))]
GAIN, FOUND = {'metric': 'gain_over_fix'}, {'metric': 'bottleneck_frequency_2px'}
PUSHED = {'metric': 'final_distance_cm', 'task': 'push2'}
ORDERED, THREE = ({'metric': 'success_5cm', 'task': task} for task in ('order2', 'order3'))
ONE = '{:.0%} ({:.0f} to {:.0f})'
PAIR = f'{ONE}; {ONE}'
TOWER = {'metric': 'success', 'task': 'stack3'}


@pytest.mark.parametrize('number, file, form, rows', [
    (0, 'prediction.json', PAIR,
     [{**GENMIN, **GAIN, 'task': task} for task in ('grasp', 'pick_place')]),
    (1, 'prediction.json', PAIR, [{**GENMIN, 'metric': metric, 'task': 'push2'} for metric in (
        'gain_over_fix', 'gain_over_fix_at_match_step')]),
    (2, 'prediction.json', '{:.0%}; {:.0%}',
     [{**method, **FOUND, 'task': 'push2'} for method in (GENMIN, FIX)]),
    (3, 'prediction.json', '{:.0%}; {:.0%}; {:.0%}',
     [{**method, **FOUND, 'task': task} for method, task in (
         (RELATIVE, 'push2'), (RELATIVE, 'push2_late'), (FIX, 'push2_late'))]),
    (4, 'prediction.json', '{:.0%}; {:.0%}',
     [{**method, 'metric': 'pick_after_place'} for method in (PIECES, WHOLE)]),
    (5, 'prediction.json', PAIR, BEST),
    (6, 'planning.json', '{:.1f} ({:.1f} to {:.1f}); {:.1f} ({:.1f} to {:.1f})',
     [{**PUSHED, 'method': 'direct'}, {**PUSHED, 'method': 'shipped'}]),
    (7, 'planning.json', PAIR, [{**ORDERED, 'method': 'direct'},
                                {**ORDERED, 'method': 'shipped'}]),
    (8, 'planning.json', PAIR, [{**ORDERED, 'method': 'fix+late'},
                                {**ORDERED, 'method': 'genmin+relative+late'}]),
    (9, 'planning.json', PAIR, [{**THREE, 'method': 'direct'},
                                {**THREE, 'method': 'shipped:rounds2'}]),
    (10, 'stacking.json', f'{PAIR}; {ONE}', [
        {**TOWER, 'method': method} for method in ('direct', 'lowest_first', 'shipped')])])
def test_the_readme_says_what_was_measured(number, file, form, rows):
    table = README.split('## Results')[1].split('|---|---|---|---|\n')[1].splitlines()
    numbers = []
    for value, low, high in (measured(file, **row) for row in rows):
        if form.count('{') == len(rows):
            numbers.append(value)
        elif '%' in form:
            numbers += [value, 100 * low, 100 * high]
        else:
            numbers += [value, low, high]
    assert table[number].split('|')[3].strip() == form.format(*numbers)


def test_the_readme_says_what_fix_has_in_order():
    shares = []
    for task, fix, ours in (('order2', 'fix', 'shipped'),
                            ('order3', 'fix+rounds:rounds2', 'shipped:rounds2')):
        value, low, _ = measured('planning.json', task=task, method=ours, compares='fix',
                                 metric='success_5cm_difference')
        assert low < 0, 'not significantly more'
        share, _, _ = measured('planning.json', task=task, method=fix, metric='success_5cm')
        shares += [share, share + value]
    assert (f'In order {shares[0]:.0%} succeed via `fix`, with two and three objects (60 scenes; '
            f'via the subgoals {shares[1]:.0%}, {shares[3]:.0%}: not significantly more)') in (
                ' '.join(README.split()))
    assert round(shares[2], 2) == round(shares[0], 2)


def test_the_findings_say_how_much_of_the_hand_is_covered():
    results = json.loads((ROOT / 'docs' / 'results' / 'hand_place.json').read_text())
    pushing, stacking = results['recordings']
    assert (pushing['task'], stacking['task']) == ('push2', 'stack2')

    def share(row, name):
        return '{:.0f}% ({:.0f} to {:.0f})'.format(
            *(100 * row[name][key] for key in ('value', 'ci_low', 'ci_high')))

    findings = text('results/findings.md')
    assert f'it covers {share(pushing, "mean_cover")} of the hand' in findings
    half = share(pushing, 'more_than_half_covered').replace('% (', '% of the episodes (')
    assert f'more than half in {half}' in findings
    assert f'in stacking it covers {share(stacking, "mean_cover")}' in findings


def test_the_papers_network_gains_what_the_readme_says():
    gains = (measured('prediction.json', **{**GENMIN, **GAIN, 'method': 'genmin'}, task=task)[0]
             for task in ('push2', 'pick_place', 'grasp'))
    assert ("With GAN the paper's network gains {:.0%} in pushing, {:.0%} in pick-and-place, "
            '{:.0%} in grasping').format(*gains) in ' '.join(README.split())


def test_the_page_on_training_says_what_the_subgoal_gains_in_order():
    via, direct = (measured('planning.json', **ORDERED, method=method)
                   for method in ('shipped', 'direct'))
    gain = measured('planning.json', task='order2', method='shipped',
                    metric='success_5cm_difference', compares='direct')
    with_it, without, more = (
        f'{100 * value:.0f}{{}} ({100 * low:.0f} to {100 * high:.0f})'
        for value, low, high in (via, direct, gain))
    assert (with_it.format('%')
            + ' of 100 scenes via the subgoal that the shipped weights predict, and in '
            + without.format('%') + ' with `direct`: '
            + more.format(' points more')) in text('training.md')


def test_the_page_on_training_says_what_the_margin_of_progress_changes():
    edge, usual = (measured('prediction.json', **{
        **GENMIN, **FOUND, 'task': 'push2', 'method': f'genmin-wo-gan+progress+skips{form}'})[0]
        for form in ('+edge', ''))
    assert (f'0.0 finds as many bottlenecks ({edge:.0%} instead of {usual:.0%})'
            in text('training.md'))


def written(file):
    """Return every value and interval of a file of the results, rounded in all ways, as texts."""
    intervals = []

    def gather(fields):
        if fields.get('ci_low') is not None:
            intervals.append((fields['value'], fields['ci_low'], fields['ci_high']))
        return fields

    json.loads((ROOT / 'docs' / 'results' / file).read_text(), object_hook=gather)
    return {
        tuple(f'{round(factor * bound, digits) + 0.0:.{digits}f}' for bound in bounds)
        for value, low, high in intervals
        for sign, bounds in ((1, (value, low, high)), (-1, (value, high, low)))
        for factor in (sign, 100 * sign) for digits in range(5)}


@pytest.mark.parametrize('page, data', [
    ('results/findings.md', ['prediction.json', 'hand_place.json']),
    ('results/planning_findings.md', ['planning.json']),
    ('results/stacking_findings.md', ['stacking.json']),
    ('training.md', ['prediction.json', 'planning.json'])])
def test_every_interval_on_a_page_stands_in_the_data(page, data):
    found = re.findall(
        r'(-?\d+(?:\.\d+)?)[^()\d]{0,60}\((-?\d+(?:\.\d+)?) to (-?\d+(?:\.\d+)?)[,;)]',
        text(page).partition('## Shipped weights')[0])  # those have model cards
    assert len(found) >= 4
    missing = set(found) - set().union(*map(written, data))
    assert not missing
