# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the page about planning shows; its sentences stand in templates/planning.md.j2."""

from functools import partial

from experiments.pages import interval, number, render
from experiments.paper.published import ORDER_TITLES, PLANNING_BOUNDS, TABLE_2
from experiments.planning.claims import claims_table
from experiments.planning.methods import BOUNDS
import pandas as pd
from sim_bridge.tasks.tasks import get_task
from tap_ros.contract import step_budget
from tap_ros.planning.forward_scores import MOVED_PIXELS
from tap_ros.planning.mpc_config import STALL

TITLES = {'push2': 'Two objects', 'push3': 'Three objects', **ORDER_TITLES}
PARTS = {'subgoal': 'the subgoal', 'maps': 'its maps', 'model': 'the forward model',
         'search': 'the search', 'cost': 'its cost', 'tracking': 'object pixels',
         'switch': 'when to go on', 'recursion': 'number of subgoals',
         'rounds': 'how often to predict',
         'samples': 'number of samples', 'replan_every': 'how often to plan',
         'step_budget': 'number of steps'}
FIRST = ('nothing', 'direct', 'fix', 'genmin', 'genmin+progress', 'genmin+relative', 'shipped')

_interval = partial(interval, digits=1, form='{}{} [{}, {}]')


def make_page(rows, strips, maps=(), findings=''):
    """
    Write the page.

    :param rows: of results.make_rows.
    :param strips: dict (task, method) -> (file name of the film strip, caption).
    :param maps: rows of evaluation.forward; may be empty.
    :param findings: Markdown that a person wrote, to stand first.
    :return: Markdown.
    """
    claims = claims_table(rows)
    rows = pd.DataFrame([{'compares': None, 'against': None, **row} for row in rows])
    maps = pd.DataFrame(maps)
    tasks = [{
        'title': TITLES.get(task, task), 'budget': step_budget(get_task(task).num_objects),
        'table': _methods(task, own), 'replaced': _replaced(own),
        'strips': [(method, *strip) for (of, method), strip in strips.items() if of == task],
    } for task, own in rows.groupby('task', sort=False)]
    return render('planning/templates/planning.md.j2', tasks=tasks, findings=findings,
                  claims=claims, commands=rows['command'].unique(), map_table=_maps(maps),
                  moved=MOVED_PIXELS, stall=STALL,
                  map_commands=[] if maps.empty else maps['command'].unique())


def _methods(task, rows):
    """Tabulate the methods of one task."""
    methods = sorted(rows['method'].unique(), key=_rank)

    def of(metric, compares=None):
        """Return a line for each method; compares: of a difference."""
        chosen = rows['metric'] == metric
        if compares:
            chosen &= rows['compares'] == compares
        return rows[chosen].set_index('method').reindex(methods)

    final = of('final_distance_cm')
    search = (number(final['planner_samples'], 0) + ' x '
              + number(final['planner_iterations'], 0))
    percent = partial(_interval, digits=0, unit=100)
    return pd.DataFrame({
        'method': [f'`{method}`' for method in methods],
        'paper': [_paper(task, method) for method in methods],
        'final distance, cm': _interval(final) + ' ± ' + number(final['standard_error'], 1),
        'minus direct, cm': _interval(of('final_distance_difference_cm', 'direct'), sign='+'),
        'minus fix, cm': _interval(of('final_distance_difference_cm', 'fix'), sign='+'),
        'all within 5 cm': percent(of('success_5cm'), after='%'),
        'minus direct, points': percent(of('success_5cm_difference', 'direct'), sign='+'),
        'minus fix, points': percent(of('success_5cm_difference', 'fix'), sign='+'),
        'minus direct with twice the samples, points': percent(
            of('success_5cm_difference', 'direct, twice'), sign='+'),
        'steps': number(of('steps')['value'], 0),
        'ms a plan': number(of('plan_ms')['value'], 0),
        'samples': search.mask(search.index == 'nothing'), 'scenes': final['n']}).dropna(
            axis='columns', how='all')


def _replaced(rows):
    """Tabulate what replacing one part of the chain, also by its true counterpart, changes."""
    rows = rows[rows['metric'] == 'final_distance_difference_cm']
    rows = rows[rows['compares'].isin(PARTS)]
    rows = rows.loc[sorted(rows.index, key=lambda i: (
        list(PARTS).index(rows['compares'][i]), _rank(rows['method'][i])))]
    return pd.DataFrame({
        'part replaced': rows['compares'].map(PARTS), '': '`' + rows['method'] + '`',
        'instead of': '`' + rows['against'] + '`',
        'changes the final distance by, cm': _interval(rows, sign='+'), 'scenes': rows['n']})


def _maps(rows):
    """Tabulate the errors of the forward model's maps; empty without rows."""
    if rows.empty:
        return rows
    rows = rows.assign(cell=_interval(rows, digits=2) + ', n = ' + rows['n'].astype('string'))
    table = rows.pivot(index=['task', 'method'], columns='step', values='cell')
    return table.add_prefix('step ').rename_axis(index=['recording', '']).reset_index()


def _rank(method):
    """Sort the paper's methods first, then their variants, then bounds."""
    base = method.split(':')[0]
    first = FIRST.index(base) if base in FIRST else len(FIRST)
    return base in BOUNDS, first, method


def _paper(task, method):
    if method in PLANNING_BOUNDS:
        return PLANNING_BOUNDS[method]
    value = TABLE_2.get((task, method.replace(':half', '').replace(':paper', '')))
    return f'{value[0]} ± {value[1]}' if value else ''
