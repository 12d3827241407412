# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the page about stacking shows; its sentences stand in templates/stacking.md.j2."""

from functools import partial

from experiments.pages import interval, number, render
from experiments.stacking.films import FAIL, SUCCEED
from experiments.stacking.methods import BOUNDS
import pandas as pd

TITLES = {'stack3': 'A tower of three blocks', 'stack2': 'One block on another',
          'pick_place': 'One object to another place'}
FIRST = ('nothing', 'direct', 'lowest_first', 'fix', 'genmin', 'genmin+progress', 'shipped')

_percent = partial(interval, digits=0, unit=100)


def make_page(rows, strips, findings=''):
    """
    Write the page.

    :param rows: of results.make_rows.
    :param strips: dict (task, method) -> file name of the picture.
    :param findings: Markdown that a person wrote, to stand first.
    :return: Markdown.
    """
    rows = pd.DataFrame([{'against': None, **row} for row in rows])
    tasks = [{
        'title': title, 'table': _methods(rows[rows['task'] == task]),
        'strips': [(method, file) for (of, method), file in strips.items() if of == task],
    } for task, title in TITLES.items() if (rows['task'] == task).any()]
    made = rows[['date', 'machine', 'version']].drop_duplicates()
    return render('stacking/templates/stacking.md.j2', tasks=tasks, findings=findings,
                  succeed=SUCCEED, fail=FAIL,
                  commands=rows['command'].unique(), made=made.itertuples(index=False))


def _methods(rows):
    """Tabulate the methods of one task."""
    methods = sorted(rows['method'].unique(), key=_rank)

    def of(metric, against=None):
        """Return a line for each method; against: of a difference."""
        chosen = rows['metric'] == metric
        if against:
            chosen &= rows['against'] == against
        return rows[chosen].set_index('method').reindex(methods)

    success = of('success')
    return pd.DataFrame({
        'method': [f'`{method}`' for method in methods],
        'success': _percent(success, after='%'),
        **{f'minus {other}, points': _percent(of('success_difference', other), sign='+')
           for other in ('direct', 'lowest_first', 'fix')},
        'first move right': _percent(of('first_right'), after='%'),
        'moves': number(of('moves')['value'], 1),
        'final distance, cm': interval(of('final_cm'), digits=1),
        'scenes': success['n']}).dropna(axis='columns', how='all')


def _rank(method):
    """Sort what is not predicted first, then predictors, then bounds."""
    base = method.split(':')[0]
    return base in BOUNDS, FIRST.index(base) if base in FIRST else len(FIRST), method
