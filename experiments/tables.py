# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tables of docs/results, from the data beside the pages.

    python -m experiments.tables

A page has its sentences from a person, and its table between two marks from here. Numbers have
their 95% intervals in brackets. Each row names the file that its numbers are of.
"""

from functools import cache
from pathlib import Path
import re
import sys

from experiments.paper.published import BOTTLENECK_2PX, GAINS, TABLE_2
import pandas as pd
from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically

RESULTS = Path(__file__).parents[1] / 'docs' / 'results'
PREDICTION, PLANNING, STACKING = 'prediction.csv', 'planning.json', 'stacking.json'
MARKS = re.compile(r'(<!-- table -->\n).*?(<!-- end -->)', re.DOTALL)
OURS = 'genmin-wo-gan{}+skips'  # our network without GAN; {}: the selection
RELATIVE, PROGRESS, FIX = OURS.format('+relative'), OURS.format('+progress'), 'fix-wo-gan+skips'
PIECES = (PROGRESS, f'{PROGRESS}+pieces')  # trained on whole episodes, and on pieces
TASKS = {'grasp': 'grasping', 'pick_place': 'pick-and-place', 'push2': 'pushing two objects'}


def find(folder, file, **wanted):
    """
    Find a row of a data file.

    :param folder: of the file.
    :param file: PREDICTION, PLANNING or STACKING.
    :param wanted: values of columns.
    :return: Series.
    :raises ConfigError: unless one row fits.
    """
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


class Tables:
    """
    The lines of each page's table: claim, paper, here, file.

    :param folder: of the data.
    """

    def __init__(self, folder=RESULTS):
        self._folder = folder

    def prediction(self):
        """Compare the paper's claims about prediction with what was measured."""
        def share(method, metric='gain_over_fix', task='push2', new_pixels=True,
                  mode='bidirectional'):
            return number(self._find(
                PREDICTION, task=task, mode=mode, method=method, metric=metric,
                new_pixels=new_pixels), 100)

        def found(method, task='push2'):
            return share(method, 'bottleneck_frequency_2px', task, new_pixels=False)

        for task, title in TASKS.items():
            same = share(OURS.format(''), 'gain_over_fix_at_match_step', task)
            yield (f'error of `genmin` below `fix`: {title}', f'{GAINS[task]:.1%}',
                   f'{share(OURS.format(""), task=task)}; at the same match-step {same}',
                   PREDICTION)
        yield ("the same, the paper's network with GAN", '',
               '; '.join(f'{share("genmin", task=task)}' for task in TASKS), PREDICTION)
        for task, title in {'stack2': 'stacking two blocks', 'push3': 'pushing three'}.items():
            yield f'the same: {title}', '', share(OURS.format(''), task=task), PREDICTION
        yield ('predictions that show hand and object, pick-and-place: `genmin`; `fix`', '',
               '; '.join(share(method, 'shows_both', 'pick_place')
                         for method in (OURS.format(''), FIX)), PREDICTION)
        yield ('from the start alone, `genmin`, beta 4: error below fixed times at the same '
               'match-step', 'lower', share('genmin4-wo-gan+skips', 'gain_over_fix_at_match_step',
                                            'grasp', mode='forward'), PREDICTION)
        yield ('bottlenecks at 2 px, pushing two objects: `genmin`; `fix`',
               f'{BOTTLENECK_2PX["genmin"]:.0%}; {BOTTLENECK_2PX["fix"]:.0%}',
               f'{found(OURS.format(""))}; {found(FIX)}', PREDICTION)
        for name, method in (('over progress', PROGRESS), ('relative to copying', RELATIVE)):
            yield f'the same: `genmin` {name}', '', found(method), PREDICTION
        for task, title in (('push2_late', 'late'), ('push2_mixed', 'at any time'),
                            ('order2', 'two objects in order'), ('push3', 'three objects')):
            yield (f'bottlenecks {title}: relative to copying; `fix`', '',
                   f'{found(RELATIVE, task)}; {found(FIX, task)}', PREDICTION)
        for task, form in (('pick_place', 'narrow'), ('push2', 'frame')):
            yield (f'best of 100 samples below the best without: {TASKS[task]}', 'lower',
                   share(f'genmin-vae-wo-gan-best-of-100+skips+{form}',
                         'gain_over_deterministic', task), PREDICTION)
        yield ('recursion, pick-and-place, over progress: the pick before the place, trained on '
               'whole episodes; on pieces', 'shown', '; '.join(share(
                   method, 'pick_after_place', 'pick_place') for method in PIECES), PREDICTION)

    def planning(self):
        """Compare the paper's claims about planning with what was measured."""
        def final(task, method, metric='final_distance_cm', **about):
            return number(self._find(PLANNING, task=task, method=method, metric=metric, **about),
                          1, 1, ' cm')

        def success(task, method, **about):
            metric = 'success_5cm_difference' if about else 'success_5cm'
            row = self._find(PLANNING, task=task, method=method, metric=metric, **about)
            return number(row, 100, 0, ' points' if about else '%', '+' if about else '')

        for task, title in (('push2', 'two'), ('push3', 'three')):
            paper = [TABLE_2[task, method][0] for method in ('direct', 'genmin')]
            less = final(task, 'shipped', 'final_distance_difference_cm', compares='direct')
            yield (f'final distance, {title} objects anywhere: direct; via the subgoal; '
                   'difference', '{} cm; {} cm; {:.1f} cm'.format(*paper, paper[1] - paper[0]),
                   f'{final(task, "direct")}; {final(task, "shipped")}; {less}', PLANNING)
        for task, shipped, title in (
                ('push2', 'shipped', 'two objects anywhere'),
                ('push3', 'shipped', 'three objects anywhere'),
                ('order2', 'shipped', 'two in order'),
                ('order3', 'shipped:rounds2', 'three in order, two predictions')):
            yield (f'success, {title}: direct; via the subgoal; difference', '', '; '.join((
                success(task, 'direct'), success(task, shipped),
                success(task, shipped, compares='direct'))), PLANNING)
        for task, fix, ours, title in (
                ('order2', 'fix', 'shipped', 'two in order'),
                ('order3', 'fix+rounds:rounds2', 'shipped:rounds2', 'three in order'),
                ('order2', 'fix+rounds', 'genmin+relative+rounds', 'two in order, trained alike'),
                ('order2', 'fix+late', 'genmin+relative+late',
                 'two in order, trained on late bottlenecks')):
            yield (f'success, {title}: via `fix`; via the subgoal minus via `fix`', '', '; '.join((
                success(task, fix), success(task, ours, compares='fix'))), PLANNING)
        yield ('success in order, told the right order: two; three objects', '', '; '.join(
            success(task, 'oracle_order') for task in ('order2', 'order3')), PLANNING)
        yield ('success with the simulator as forward model, direct: two anywhere; two in order',
               '', '; '.join(success(task, 'true_model') for task in ('push2', 'order2')),
               PLANNING)

    def stacking(self):
        """Say how many towers stand."""
        def share(task, method, metric='success', **about):
            return number(self._find(STACKING, task=task, method=method, metric=metric, **about),
                          100)

        methods = {'direct': 'the goal picture alone', 'lowest_first': 'a rule: lowest first',
                   'shipped': 'via one predicted subgoal',
                   'shipped:recursion2': 'via two predicted subgoals',
                   'true_subgoals': 'via true subgoals',
                   'oracle_order': 'told the right order'}
        for method, title in methods.items():
            yield (f'a tower of three: {title}', '', f'{share("stack3", method)}; first move '
                   f'right {share("stack3", method, "first_right")}', STACKING)
        less = self._find(STACKING, task='stack3', method='shipped', metric='success_difference',
                          against='lowest_first')
        yield ('a tower of three: via one subgoal minus the rule', '',
               number(less, 100, 0, ' points', '+'), STACKING)
        for task, title in (('stack2', 'one block on another'), ('pick_place', 'one object')):
            yield (f'{title}: the goal picture alone; via one subgoal; via two', '', '; '.join(
                share(task, method) for method in ('direct', 'shipped', 'shipped:recursion2')),
                STACKING)

    def _find(self, file, **wanted):
        return find(self._folder, file, **wanted)


def markdown(lines):
    """Write lines of claim, paper, here, file as a table."""
    rows = [('claim', 'paper', 'here', 'file'), ('---',) * 4,
            *((*cells, f'[data]({file})') for *cells, file in lines)]
    return ''.join(f'| {" | ".join(row)} |\n' for row in rows)


def filled(name, folder=RESULTS):
    """Return a page of results, 'prediction', 'planning' or 'stacking', with its table anew."""
    text = (Path(folder) / f'{name}.md').read_text()
    table = markdown(getattr(Tables(folder), name)())
    if not MARKS.search(text):
        raise ConfigError(f'{name}.md: expected <!-- table --> and <!-- end -->')
    return MARKS.sub(lambda found: found[1] + table + found[2], text)


if __name__ == '__main__':
    for page in sys.argv[1:] or ('prediction', 'planning', 'stacking'):
        write_atomically(RESULTS / f'{page}.md', filled(page))
