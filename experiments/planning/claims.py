# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's claims and our targets beside our numbers."""

from experiments.paper.published import TABLE_2
import pandas as pd

OURS = 'shipped'
_FIX = 'via the subgoal of `fix`'
SUCCESS = (
    ('order2', OURS, 'direct', 'direct'), ('order2', OURS, 'fix', _FIX),
    ('order2', 'genmin+relative+rounds', 'fix', f'{_FIX}, both trained longer (`+rounds`)'),
    ('order2', 'genmin+relative+late', 'fix', f'{_FIX}, both trained on late bottlenecks'),
    # Three objects in order have two bottlenecks, so subgoals are predicted twice.
    ('order3', f'{OURS}:rounds2', 'direct', 'direct'),
    ('order3', f'{OURS}:rounds2', 'fix', _FIX))
MOST_CM = {'push2': 2.5, 'push3': 3.0}  # via the subgoal
POINTS = 0.2  # of success, more than direct and than fix
_OBJECTS = {'push2': 'two objects', 'push3': 'three objects',
            'order2': 'two, one on the goal of the other',
            'order3': 'three, two on goals of others'}


def claims_table(rows):
    """
    Compare every claim with what was measured.

    :param rows: of results.make_rows.
    :return: DataFrame of text: claim, paper, target, here, met.
    """
    lines = []

    def find(task, method, metric, compares=None):
        return next((row for row in rows if (row['task'], row['method'], row['metric'],
                                             row.get('compares')) == (
            task, method, metric, compares)), None)

    for task in ('push2', 'push3'):
        final = find(task, OURS, 'final_distance_cm')
        less = find(task, OURS, 'final_distance_difference_cm', 'direct')
        paper = TABLE_2[task, 'genmin'][0], TABLE_2[task, 'direct'][0]
        lines.append((
            f'final distance via the subgoal, {_OBJECTS[task]}', f'{paper[0]} cm',
            f'at most {MOST_CM[task]} cm', _text(final, 1, ' cm'),
            _met(final and final['value'] <= MOST_CM[task])))
        lines.append((
            f'the same, minus direct, {_OBJECTS[task]}', f'{paper[0] - paper[1]:.1f} cm',
            'interval below 0', _text(less, 1, ' cm', '+'),
            _met(less and less['ci_high'] < 0)))
    for task, method, other, text in SUCCESS:
        more = find(task, method, 'success_5cm_difference', other)
        lines.append((
            f'success via the subgoal minus {text}, {_OBJECTS[task]}', '',
            f'at least {100 * POINTS:.0f} points, interval above 0',
            _text(more, 0, ' points', '+', 100),
            _met(more and more['value'] >= POINTS and more['ci_low'] > 0)))
    return pd.DataFrame(lines, columns=['claim', 'paper', 'target', 'here', 'met'])


def _text(row, digits, after, sign='', unit=1):
    if row is None:
        return ''
    value, low, high = (f'{unit * row[name]:{sign}.{digits}f}'
                        for name in ('value', 'ci_low', 'ci_high'))
    return f'{value}{after} ({low} to {high}), {row["n"]} scenes'


def _met(is_met):
    return {None: '*not run*', True: 'yes', False: 'no'}[is_met]
