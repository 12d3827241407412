# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page about planning, in Markdown, from the rows of planning.json."""

from experiments.paper.published import PLANNING_BOUNDS, TABLE_2
from experiments.planning.methods import BOUNDS

TITLES = {'push2': 'Two objects', 'push3': 'Three objects'}
PARTS = {'subgoal': 'the subgoal', 'maps': 'its maps', 'model': 'the forward model',
         'search': 'the search', 'cost': 'its cost', 'tracking': 'object pixels',
         'switch': 'when to go on', 'recursion': 'number of subgoals',
         'samples': 'number of samples', 'replan_every': 'how often to plan'}
FIRST = ('nothing', 'direct', 'fix', 'genmin')

HOW_TO_READ = """\
Final distances are in three dimensions from each object's origin to its goal, mean over the
objects, in centimetres, with their standard error; a success has every object within 5 cm. In
brackets are 95% bootstrap intervals over scenes. All methods push the same scenes, so that
differences are paired: less than 0 is better. Each method is compared with `direct` and `fix` in
the same planner. The time of a plan is that of one thread beside others that plan at the same
time; `python -m tap_ros bench planning` measures the speed. The paper's numbers (with their
standard error) are from its own world, objects and planner: the order of methods can be compared,
the centimetres only roughly.

`one_object`, `oracle_order`, `true_subgoal` and `true_model` are bounds, which know more than a
robot would: each object alone with the whole budget; one object after another, the nearest first;
the subgoal's true positions, the nearest object moved; the simulator as forward model.

What stands behind a colon replaces one part of the chain: `half` switches at half the budget as
the paper does, otherwise a subgoal is left when it is reached or half the budget is spent;
`recursion2` takes two subgoals in a row; `samples8` chooses among 8 by the planner's own cost;
`true_maps` takes the objects' positions from the true configuration that looks most like the
predicted picture; `true_model` plans with the simulator; `more_search` searches with 200 samples
and 3 iterations; `paper` searches as the paper does, with displacements drawn
from a Gaussian instead of whole pushes and no warm start; `plain_cost` minimises the plain sum of
distances, as the paper does, without our preference for bringing one object home before the next;
`every2` plans anew at every second action. Object pixels come from the simulator's ground truth at
every step, except with `carried`: there only in the first picture, then the forward model carries
them and the camera's pictures correct them.
"""


def make_page(rows, strips, maps=(), findings=''):
    """
    Write the page.

    :param rows: of results.make_rows.
    :param strips: dict (task, method) -> (file name of the film strip, caption).
    :param maps: rows of evaluation.forward; may be empty.
    :param findings: Markdown that a person wrote, to stand first.
    :return: Markdown.
    """
    parts = [
        '# Planning results\n',
        'Made by `python -m tap_ros evaluate planning` from the files in [planning](planning), '
        'never typed; as data: [planning.json](planning.json).\n',
        *([findings] if findings else []), HOW_TO_READ]
    for task in dict.fromkeys(row['task'] for row in rows):
        own = [row for row in rows if row['task'] == task]
        budget = own[0]['step_budget']
        parts += [f'## {TITLES.get(task, task)}, at most {budget} steps\n', _table(task, own)]
        parts += _replaced(own)
        for (of, method), (name, caption) in strips.items():
            if of == task:
                parts.append(f'**{method}**, {caption}:\n\n![{method}]({name})\n')
    parts += _maps(maps)
    parts.append('## Commands\n')
    parts += [f'    {command}' for command in dict.fromkeys(row['command'] for row in rows)]
    return '\n'.join(parts) + '\n'


def _table(task, rows):
    """Return the table of one task."""
    lines = ['| method | paper | final distance, cm | minus direct, cm | minus fix, cm '
             '| all within 5 cm | minus direct, points | steps | ms a plan | samples | scenes |',
             '|---' * 11 + '|']
    methods = list(dict.fromkeys(row['method'] for row in rows))
    for method in sorted(methods, key=_rank):
        own = {(r['metric'], r.get('compares')): r for r in rows if r['method'] == method}
        final = own['final_distance_cm', None]
        search = f'{final["planner_samples"]} x {final["planner_iterations"]}'
        lines.append('| ' + ' | '.join([
            f'`{method}`', _paper(task, method),
            f'{_value(final)} ± {final["standard_error"]:.1f}',
            _value(own.get(('final_distance_difference_cm', 'direct')), '+.1f'),
            _value(own.get(('final_distance_difference_cm', 'fix')), '+.1f'),
            _share(own['success_5cm', None]),
            _share(own.get(('success_5cm_difference', 'direct')), '+.0f', ''),
            f'{own["steps", None]["value"]:.0f}',
            f'{own["plan_ms", None]["value"]:.0f}' if ('plan_ms', None) in own else '',
            search if method != 'nothing' else '', str(final['n'])]) + ' |')
    return '\n'.join(lines) + '\n'


def _replaced(rows):
    """Say what replacing one part of the chain by another, or by its true counterpart, changes."""
    changed = [row for row in rows if row['metric'] == 'final_distance_difference_cm'
               and row['compares'] in PARTS]
    if not changed:
        return []
    lines = ['| part replaced | | instead of | changes the final distance by, cm | scenes |',
             '|---|---|---|---:|---:|']
    lines += [f'| {PARTS[row["compares"]]} | `{row["method"]}` | `{row["against"]}` '
              f'| {_value(row, "+.1f")} | {row["n"]} |'
              for row in sorted(changed, key=lambda row: (
                  list(PARTS).index(row['compares']), _rank(row['method'])))]
    return ['\n'.join(lines) + '\n']


def _maps(rows):
    """Write the table of the forward model's maps."""
    if not rows:
        return []
    steps = list(dict.fromkeys(row['step'] for row in rows))
    lines = ['| recording | | ' + ' | '.join(f'step {step}' for step in steps) + ' |',
             '|---|---|' + '---:|' * len(steps)]
    for task, method in dict.fromkeys((row['task'], row['method']) for row in rows):
        own = {row['step']: row for row in rows if (row['task'], row['method']) == (task, method)}
        lines.append(f'| {task} | {method} | ' + ' | '.join(
            f'{_value(own[step], ".2f")}, n = {own[step]["n"]}' if step in own else ''
            for step in steps) + ' |')
    return ['## Object maps carried by the forward model\n',
            'Pixels from the expected pixel of the map to the true one, so many control periods '
            'ahead, on held-out episodes, for objects that moved more than 2 px; maps begin at '
            'the true pixels. A pixel is about 1.6 cm on the table. true_simulator puts the maps '
            'where the objects went; its error is that of the grid on which maps are kept.\n',
            '\n'.join(lines) + '\n',
            *(f'    {command}' for command in dict.fromkeys(
                row['command'] for row in rows)), '']


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


def _share(row, form='.0f', unit='%'):
    if row is None:
        return ''
    value, low, high = (f'{100 * row[name]:{form}}' for name in ('value', 'ci_low', 'ci_high'))
    return f'{value}{unit} [{low}, {high}]'


def _value(row, form='.1f'):
    if row is None:
        return ''
    return f'{row["value"]:{form}} [{row["ci_low"]:{form}}, {row["ci_high"]:{form}}]'
