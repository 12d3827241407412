# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tables of docs/results, from the data beside the pages.

    python -m experiments.tables

A page has its sentences from a person, and its table between two marks from here. Numbers have
their 95% intervals in brackets. A row is reached if its number is at least the paper's; where the
aim is `over` something, if the interval is.
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
TASKS = {'grasp': 'grasping', 'pick_place': 'pick-and-place', 'push2': 'pushing two objects'}


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


def reached(yes, *aim):
    """Return whether an aim is reached."""
    return ': '.join(('reached' if yes else '**missed**', *aim))


class Tables:
    """The lines of each page's table: claim, paper, here, reached or missed."""

    def prediction(self):
        """Compare the paper's claims about prediction with what was measured."""
        def row(method, metric='gain_over_fix', task='push2', new_pixels=True,
                mode='bidirectional'):
            return find(RESULTS, PREDICTION, task=task, mode=mode, method=method, metric=metric,
                        new_pixels=new_pixels)

        def found(method, task='push2'):
            return row(method, 'bottleneck_frequency_2px', task, new_pixels=False)

        def some(claim, measured, papers=(), said=''):
            """Return one line of several numbers, each with that of the paper."""
            if not papers:
                aims = [reached(each['ci_low'] > 0) for each in measured]
                return (claim, said, '; '.join(number(each, 100) for each in measured),
                        '; '.join(aims if len(set(aims)) > 1 else aims[:1]) + ': over 0')
            return (claim, '; '.join(dict.fromkeys(
                f'{paper:.1%}'.replace('.0%', '%') for paper in papers)),
                '; '.join(number(each, 100) for each in measured), '; '.join(
                    reached(each['value'] >= paper)
                    for each, paper in zip(measured, papers, strict=True)))

        def two(claim, ours, fix):
            return (f'{claim}: `genmin`; `fix`', '', f'{number(ours, 100)}; {number(fix, 100)}',
                    reached(ours['ci_low'] > fix['ci_high'], 'over `fix`'))

        plain, tasks = OURS.format(''), '; '.join(TASKS.values())
        for method, network in ((plain, ''), ('genmin', "the paper's network with GAN, ")):
            yield some(f'`genmin` below `fix`: {network}{tasks}',
                       [row(method, task=task) for task in TASKS], [*map(GAINS.get, TASKS)])
        yield some(f'`genmin` below `fix` at the same match-step: {tasks}', [
            row(plain, 'gain_over_fix_at_match_step', task) for task in TASKS])
        yield some('`genmin` below `fix`: stacking two blocks; pushing three', [
            row(plain, task=task) for task in ('stack2', 'push3')])
        yield two('predictions that show hand and object, pick-and-place',
                  *(row(method, 'shows_both', 'pick_place') for method in (plain, FIX)))
        yield some('`genmin`, beta 4, below fixed times at the same match-step: grasping, from '
                   'the start alone', [row(
                       'genmin4-wo-gan+skips', 'gain_over_fix_at_match_step', 'grasp',
                       mode='forward')], said='lower')
        bottlenecks = 'bottlenecks found, pushing two objects'
        yield some(f'{bottlenecks}: `genmin`; over progress; relative to copying', [
            found(method) for method in (plain, PROGRESS, RELATIVE)],
            3 * [BOTTLENECK_2PX['genmin']])
        yield (f'{bottlenecks}: `fix` finds none', f'{BOTTLENECK_2PX["fix"]:.0%}',
               number(found(FIX), 100), reached(found(FIX)['value'] == 0))
        for task, title in (('push2_late', 'late in the recordings'),
                            ('push2_mixed', 'at any time'),
                            ('order2', 'two objects in order'), ('push3', 'three objects')):
            yield two(f'bottlenecks found, {title}, relative to copying', found(RELATIVE, task),
                      found(FIX, task))
        yield some(f'best of 100 samples below the best without: {tasks}', [
            row(f'genmin-vae-wo-gan-best-of-100+skips{form}', 'gain_over_deterministic', task)
            for task, form in zip(TASKS, ('', '+narrow', '+frame'), strict=True)], said='lower')
        yield some('recursion, pick-and-place, over progress: pick before place, trained on whole '
                   'episodes; on pieces', [
                       row(method, 'pick_after_place', 'pick_place') for method in PIECES],
                   said='shown')

    def planning(self):
        """Compare the paper's claims about planning with what was measured."""
        def final(task, method, metric='final_distance_cm', **about):
            return find(RESULTS, PLANNING, task=task, method=method, metric=metric, **about)

        def success(task, method, file=PLANNING, **about):
            metric = 'success_5cm_difference' if about else 'success_5cm'
            return find(RESULTS, file, task=task, method=method, metric=metric, **about)

        def points(row):
            return number(row, 100, 0, ' points', '+')

        for task, title in (('push2', 'two'), ('push3', 'three')):
            paper = [TABLE_2[task, method][0] for method in ('direct', 'genmin')]
            less = final(task, 'shipped', 'final_distance_difference_cm', compares='direct')
            yield (f'final distance, {title} objects anywhere: direct; via the subgoal; '
                   'difference (paper: {} cm; {} cm; {:.1f} cm)'.format(
                       *paper, paper[1] - paper[0]), '',
                   '; '.join(number(row, 1, 1, ' cm') for row in (
                       final(task, 'direct'), final(task, 'shipped'), less)),
                   reached(less['ci_high'] < 0, 'nearer'))
        for task, shipped, title in (
                ('push2', 'shipped', 'two objects anywhere'),
                ('push3', 'shipped', 'three objects anywhere'),
                ('order2', 'shipped', 'two in order'),
                ('order3', 'shipped:rounds2', 'three in order, two predictions')):
            more = success(task, shipped, compares='direct')
            yield (f'{title}: direct; via the subgoal; difference', '', '; '.join((
                number(success(task, 'direct'), 100), number(success(task, shipped), 100),
                points(more))), reached(more['ci_low'] > 0, 'over direct'))
        late3 = 'order3', 'fix+late:rounds2', 'genmin+relative+late:rounds2'
        for task, fix, ours, title, *file in (
                ('order2', 'fix', 'shipped', 'two in order'),
                ('order3', 'fix+rounds:rounds2', 'shipped:rounds2', 'three in order'),
                ('order2', 'fix+rounds', 'genmin+relative+rounds', 'two in order, trained alike'),
                ('order2', 'fix+late', 'genmin+relative+late', 'two in order, late'),
                (*late3, 'three in order, late', LATE)):
            more = success(task, ours, *file, compares='fix')
            yield (f'{title}: via `fix`; difference', '', '; '.join((
                number(success(task, fix, *file), 100), points(more))),
                reached(more['value'] >= 0.2, '20 points'))
        for compares, title in (('fix', '`fix`'), ('direct', 'direct')):
            more = [success('order2', f'genmin+relative+late{seed}', file, compares=compares)
                    for seed, file in (('', PLANNING), ('-s1', LATE), ('-s2', LATE))]
            yield (f'two in order, late, three trainings: difference from {title}',
                   '', '; '.join(map(points, more)), reached(
                       sum(row['value'] for row in more) / 3 >= 0.2
                       and min(row['ci_low'] for row in more) > 0, '20 points'))
        more = success(*late3[::2], LATE, compares='direct')
        yield ('three in order, late: difference from direct', '', points(more),
               reached(more['value'] >= 0.2, '20 points'))
        yield ('told the right order: two; three in order', '', '; '.join(
            number(success(task, 'oracle_order'), 100) for task in ('order2', 'order3')),
            '')
        yield ('with the simulator as forward model, direct: two anywhere; two in order',
               '', '; '.join(number(success(task, 'true_model'), 100)
                             for task in ('push2', 'order2')), '')

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
            aimed = reached(stands['ci_low'] > direct['ci_high'], 'over the goal picture alone')
            yield (title, '',
                   f'{number(stands, 100)}; {number(first, 100)}',
                   aimed if 'shipped' in method else '')
        for other, title, least, aim in (('fix', 'via `fix`', 0.2, '20 points'),
                                         ('lowest_first', 'the rule', 0, 'over the rule')):
            more = row('stack3', 'shipped', 'success_difference', against=other)
            yield (f'via one subgoal minus {title}', '',
                   number(more, 100, 0, ' points', '+'),
                   reached(more['value'] >= least and more['ci_low'] > 0, aim))
        yield ('two blocks: the goal picture alone; via one subgoal; via two', '', '; '.join(
            number(row('stack2', method), 100)
            for method in ('direct', 'shipped', 'shipped:recursion2')), '')

    def speed(self):
        """List what `make bench` measured and has an aim, a column for each machine."""
        found = {}
        for row in measured_speed()['rows']:
            if row['aim']:
                here, ratio = Row(**{one.name: row[one.name] for one in fields(Row)}).cells[1:3]
                found.setdefault((row['what'], row['aim']), {})[row['machine']] = (
                    f'{"" if row["reached"] else "**missed**: "}{here}; {ratio}')
        for (what, aim), cells in found.items():
            yield (what, *(cells.get(machine, '') for machine in machines()), aim)


def measured_speed():
    """Return what `make bench` wrote: rows, each with where, when and of which code it is."""
    return json.loads(SPEED.read_text())


def machines():
    """Return by each machine that rows of speed are of their commits and dates, in words."""
    found = {}
    for row in measured_speed()['rows']:
        if row['aim']:
            found.setdefault(row['machine'], {})[f'{row["commit"]} of {row["date"]}'] = None
    return {machine: ', '.join(each) for machine, each in found.items()}


def markdown(lines, head=('claim', 'paper', 'here', 'aim')):
    """Write lines as a table, without the columns that are empty."""
    table = pd.DataFrame(lines, columns=head)
    return pages.markdown(table.loc[:, (table != '').any()], left=len(head)) + '\n'


def page_path(name):
    """Return where a page is."""
    return RESULTS.parent / 'speed.md' if name == 'speed' else RESULTS / f'{name}.md'


def filled(name):
    """Return a page, 'prediction', 'planning', 'stacking' or 'speed', with its table anew."""
    text = page_path(name).read_text()
    head = {}
    if name == 'speed':
        head = {'head': ('what', *(f'{machine} ({made})' for machine, made in machines().items()),
                         'aim')}
    table = markdown(getattr(Tables(), name)(), **head)
    if not MARKS.search(text):
        raise ConfigError(f'{name}.md: expected <!-- table --> and <!-- end -->')
    return MARKS.sub(lambda found: found[1] + table + found[2], text)


if __name__ == '__main__':
    for page in sys.argv[1:] or ('prediction', 'planning', 'stacking', 'speed'):
        write_atomically(page_path(page), filled(page))
