# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The numbers of docs/results, from the data beside the pages.

    python -m experiments.tables

A page has its sentences from a person, and its numbers between two marks from here: lists, on
docs/speed.md a table. Numbers have their 95% intervals in brackets. A number is missed if it is
worse than the paper's; where there is none, unless its whole interval is above 0, or `fix`.
"""

from dataclasses import fields
from functools import cache
import json
from pathlib import Path
import re
import sys

from experiments import pages
from experiments.bench.rows import Row
from experiments.paper.published import BOTTLENECK_2PX, GAINS, TABLE_2
import pandas as pd
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically

RESULTS = Path(__file__).parents[1] / 'docs' / 'results'
SPEED = RESULTS / 'speed.json'
PREDICTION, PLANNING, STACKING = 'prediction.csv', 'planning.json', 'stacking.json'
LATE = 'late/planning.json'  # three objects in order, trained on late bottlenecks
MARKS = re.compile(r'(<!-- table -->\n).*?(<!-- end -->)', re.DOTALL)
OURS = 'genmin-wo-gan{}+skips'  # our network without GAN; {}: the selection
RELATIVE, PROGRESS, FIX = OURS.format('+relative'), OURS.format('+progress'), 'fix-wo-gan+skips'
PIECES = (PROGRESS, f'{PROGRESS}+pieces')  # trained on whole episodes, and on pieces
TASKS = {'grasp': 'grasping', 'pick_place': 'pick-and-place', 'push2': 'pushing'}


def find(folder, file, **wanted):
    """Return the one row of a data file whose columns have these values; ConfigError otherwise."""
    path = Path(folder) / file
    rows = read(path)
    if not {'compares', 'against'} & set(wanted):  # no difference
        wanted = {column: None for column in ('compares', 'against') if column in rows} | wanted
    for column, value in wanted.items():
        rows = rows[rows[column].isna() if value is None else rows[column] == value]
    if len(rows) != 1:
        raise ConfigError(f'{path}: {len(rows)} rows have {wanted}; expected one')
    return rows.iloc[0]


@cache
def read(path):
    """Return the rows of a data file as a DataFrame."""
    return pd.read_csv(path) if path.suffix == '.csv' else pd.read_json(path)


def number(row, unit=1.0, digits=0, after='%', sign=''):
    """Write a row as '40% (37 to 43)'."""
    value, low, high = (f'{unit * row[name] + 0.0:{sign}.{digits}f}'
                        for name in ('value', 'ci_low', 'ci_high'))
    return f'{value}{after} ({low} to {high})'


def said(text, yes=True):
    """Return a text, and whether what it says was missed."""
    return text if yes else f'{text}, **missed**'


class Tables:
    """The lines of each page: lists in Markdown, of speed cells of a table."""

    def prediction(self):
        """Compare the paper's claims about prediction with what was measured."""
        def row(method, metric='gain_over_fix', task='push2', new_pixels=True,
                mode='bidirectional'):
            return find(RESULTS, PREDICTION, task=task, mode=mode, method=method, metric=metric,
                        new_pixels=new_pixels)

        def found(method, task='push2'):
            return row(method, 'bottleneck_frequency_2px', task, new_pixels=False)

        def line(claim, measured, least=None):
            """Return one line of several numbers; `least` has of each what the paper has."""
            least = least or {}
            papers = ', '.join(dict.fromkeys(
                f'{paper:.1%}'.replace('.0%', '%') for paper in least.values()))
            return f'- {claim}{f" (paper: {papers})" if papers else ""}: ' + '; '.join(
                said(f'{name} {number(each, 100)}', each['value'] >= least[name] if least
                     else each['ci_low'] > 0) for name, each in measured.items())

        def pair(name, ours, fix):
            return said(f'{name} {number(ours, 100)}, `fix` {number(fix, 100)}',
                        ours['ci_low'] > fix['ci_high'])

        plain = OURS.format('')
        gains = {title: GAINS[task] for task, title in TASKS.items()}
        for method, network in ((plain, ''), ('genmin', ", the paper's network with GAN")):
            yield line(f'`genmin` below `fix`{network}', {
                title: row(method, task=task) for task, title in TASKS.items()}, gains)
        yield line('`genmin` below `fix` at the same match-step', {
            title: row(plain, 'gain_over_fix_at_match_step', task)
            for task, title in TASKS.items()})
        yield line('`genmin` below `fix`', {
            title: row(plain, task=task) for task, title in (
                ('stack2', 'stacking two blocks'), ('push3', 'pushing three'))})
        yield line('`genmin` of beta 4 below fixed times at the same match-step', {
            'grasping from the start alone': row(
                'genmin4-wo-gan+skips', 'gain_over_fix_at_match_step', 'grasp', mode='forward')})
        yield '- predictions that show hand and object, pick-and-place: ' + pair('`genmin`', *(
            row(method, 'shows_both', 'pick_place') for method in (plain, FIX)))
        ways = {'`genmin`': plain, 'over progress': PROGRESS, 'relative to copying': RELATIVE}
        yield line('bottlenecks found, pushing', {
            name: found(method) for name, method in ways.items()},
            dict.fromkeys(ways, BOTTLENECK_2PX['genmin']))
        yield said('- bottlenecks found by `fix`, pushing (paper: none): '
                   + number(found(FIX), 100), found(FIX)['value'] <= BOTTLENECK_2PX['fix'])
        yield '- bottlenecks found, relative to copying: ' + '; '.join(
            pair(title, found(RELATIVE, task), found(FIX, task)) for task, title in (
                ('push2_late', 'late in the recordings'), ('push2_mixed', 'at any time'),
                ('order2', 'two objects in order'), ('push3', 'three objects')))
        yield line('best of 100 samples below the best without', {
            title: row(f'genmin-vae-wo-gan-best-of-100+skips{form}', 'gain_over_deterministic',
                       task)
            for (task, title), form in zip(TASKS.items(), ('', '+narrow', '+frame'))})
        yield line('recursion over progress, pick-and-place, pick before place', {
            title: row(method, 'pick_after_place', 'pick_place') for title, method in zip(
                ('trained on whole episodes', 'on pieces'), PIECES)})

    def planning(self):
        """Compare the paper's claims about planning with what was measured."""
        def final(task, method, metric='final_distance_cm', **about):
            return find(RESULTS, PLANNING, task=task, method=method, metric=metric, **about)

        def success(task, method, file=PLANNING, **about):
            metric = 'success_5cm_difference' if about else 'success_5cm'
            return find(RESULTS, file, task=task, method=method, metric=metric, **about)

        def points(row):
            return number(row, 100, 0, '', '+')

        yield ('Directly, via the subgoal, and the difference, points or cm (aim: its whole '
               'interval better):\n')
        for task, title in (('push2', 'two'), ('push3', 'three')):
            paper = [TABLE_2[task, method][0] for method in ('direct', 'genmin')]
            less = final(task, 'shipped', 'final_distance_difference_cm', compares='direct')
            yield said(f'- final distance in cm, {title} objects anywhere: ' + ', '.join(
                number(row, 1, 1, '') for row in (
                    final(task, 'direct'), final(task, 'shipped'), less)) + (
                        '; paper: {}, {}, {:.1f}'.format(*paper, paper[1] - paper[0])),
                less['ci_high'] < 0)
        for task, shipped, title in (
                ('push2', 'shipped', 'two objects anywhere'),
                ('push3', 'shipped', 'three objects anywhere'),
                ('order2', 'shipped', 'two in order'),
                ('order3', 'shipped:rounds2', 'three in order, two predictions')):
            more = success(task, shipped, compares='direct')
            yield said(f'- {title}: ' + ', '.join((
                number(success(task, 'direct'), 100), number(success(task, shipped), 100),
                points(more))), more['ci_low'] > 0)
        yield '\nVia `fix`, and how many points more via the subgoal (aim: 20):\n'
        for task, fix, ours, title in (
                ('order2', 'fix', 'shipped', 'two in order'),
                ('order3', 'fix+rounds:rounds2', 'shipped:rounds2', 'three in order'),
                ('order2', 'fix+rounds', 'genmin+relative+rounds', 'two in order, trained alike')):
            more = success(task, ours, compares='fix')
            yield said(f'- {title}: {number(success(task, fix), 100)}, {points(more)}',
                       more['value'] >= 0.2)
        late = 'genmin+relative+late'
        for task, fix, title, *trainings in (
                ('order2', 'fix+late', 'two in order, late, three trainings', (late, PLANNING),
                 (f'{late}-s1', LATE), (f'{late}-s2', LATE)),
                ('order3', 'fix+late:rounds2', 'three in order, late', (f'{late}:rounds2', LATE))):
            than_fix, than_direct = (
                said(', '.join(map(points, more)), min(row['ci_low'] for row in more) > 0
                     and sum(row['value'] for row in more) >= 0.2 * len(more))
                for more in ([success(task, *ours, compares=compares) for ours in trainings]
                             for compares in ('fix', 'direct')))
            yield (f'- {title}: {number(success(task, fix, trainings[0][1]), 100)}, {than_fix}; '
                   f'than directly {than_direct}')
        yield '\nFor comparison:\n'
        for title, method, tasks in (
                ('told the right order', 'oracle_order',
                 {'order2': 'two in order', 'order3': 'three'}),
                ('directly, with the simulator as forward model', 'true_model',
                 {'push2': 'two anywhere', 'order2': 'in order'})):
            yield f'- {title}: ' + ', '.join(
                f'{name} {number(success(task, method), 100)}' for task, name in tasks.items())

    def stacking(self):
        """Say how many towers stand."""
        def row(task, method, metric='success', **about):
            return find(RESULTS, STACKING, task=task, method=method, metric=metric, **about)

        methods = {'direct': 'the goal picture alone', 'lowest_first': 'a rule, lowest first',
                   'fix': 'via one predicted subgoal of `fix`',
                   'shipped': 'via one predicted subgoal',
                   'shipped:recursion2': 'via two predicted subgoals',
                   'true_subgoals': 'via true subgoals',
                   'oracle_order': 'told the right order'}
        direct = row('stack3', 'direct')
        for method, title in methods.items():
            stands, first = row('stack3', method), row('stack3', method, 'first_right')
            yield said(f'- {title}: {number(stands, 100)}, {number(first, 100)}',
                       'shipped' not in method or stands['ci_low'] > direct['ci_high'])
        for other, title, least, aim in (('fix', 'via `fix`', 0.2, '20 points'),
                                         ('lowest_first', 'the rule', 0, 'over 0')):
            more = row('stack3', 'shipped', 'success_difference', against=other)
            yield said(f'- via one subgoal minus {title} (aim: {aim}): '
                       + number(more, 100, 0, ' points', '+'),
                       more['value'] >= least and more['ci_low'] > 0)
        yield '- two blocks: ' + ', '.join(
            f'{title} {number(row("stack2", method), 100)}' for method, title in (
                ('direct', 'the goal picture alone'), ('shipped', 'via one subgoal'),
                ('shipped:recursion2', 'via two')))

    def speed(self):
        """List what `make bench` measured and has an aim, a column for each machine."""
        found, columns = {}, machines()
        for row in measured_speed()['rows']:
            if row['aim']:
                here, ratio = Row(**{one.name: row[one.name] for one in fields(Row)}).cells[1:3]
                found.setdefault((row['what'], row['aim']), {})[row['machine']] = (
                    f'{"" if row["reached"] else "**missed**: "}{here}; {ratio}')
        for (what, aim), cells in found.items():
            yield (what, *(cells.get(machine, '') for machine in columns), aim)


def measured_speed():
    """Return what `make bench` wrote: rows, each with where, when and of which code it is."""
    return json.loads(SPEED.read_text())


def machines():
    """Return by each machine that rows of speed are of their commits and dates, in words."""
    found = {}
    for row in measured_speed()['rows']:
        if row['aim']:
            found.setdefault(row['machine'], {})[f'{row["commit"]} of {row["date"]}'] = None
    return {machine: ', '.join(found[machine]) for machine in sorted(found)}


def page_path(name):
    """Return where a page is."""
    return RESULTS.parent / 'speed.md' if name == 'speed' else RESULTS / f'{name}.md'


def filled(name):
    """Return a page, 'prediction', 'planning', 'stacking' or 'speed', with its numbers anew."""
    text = page_path(name).read_text()
    lines = list(getattr(Tables(), name)())
    if name == 'speed':
        head = 'what', *(f'{machine} ({made})' for machine, made in machines().items()), 'aim'
        made = pages.markdown(pd.DataFrame(lines, columns=head), left=len(head))
    else:
        made = '\n'.join(lines)
    if not MARKS.search(text):
        raise ConfigError(f'{name}.md: expected <!-- table --> and <!-- end -->')
    return MARKS.sub(lambda found: f'{found[1]}{made}\n{found[2]}', text)


if __name__ == '__main__':
    for page in sys.argv[1:] or ('prediction', 'planning', 'stacking', 'speed'):
        write_atomically(page_path(page), filled(page))
