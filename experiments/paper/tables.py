# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of the results page, as Markdown."""

from experiments.paper.published import (
    BOTTLENECK_2PX,
    FORWARD_GRASP,
    GAINS,
    TABLE_1,
    TITLES,
)
from experiments.paper.rows import BEST, best_of_name, find, method_order
from experiments.paper.runs import paper_runs
from tap_ros.evaluation.bottleneck import THRESHOLDS

NOT_RUN = '*not run*'
# Match-steps within this share of the episode are called equal; between fix and genmin the
# paper's own lie up to 0.11 apart.
EQUAL = 0.10


def markdown(header, lines, left=1):
    """
    Write a table.

    :param header: list of str.
    :param lines: list of lists of str.
    :param left: so many columns are aligned to the left, the others to the right.
    """
    rule = ['---'] * left + ['---:'] * (len(header) - left)
    return '\n'.join(f'| {" | ".join(line)} |' for line in [header, rule, *lines]) + '\n'


def with_interval(row, digits=4, unit=1, sign=''):
    """Write a row's value with its interval: '0.0123 (0.0120 to 0.0126)'; '-' for None."""
    if row is None:
        return '-'
    value, low, high = (f'{row[name] * unit:{sign}.{digits}f}'
                        for name in ('value', 'ci_low', 'ci_high'))
    return f'{value} ({low} to {high})'


def plain(value, digits=4, unit=1, after=''):
    """Write a number, or '-' for None."""
    return '-' if value is None else f'{value * unit:.{digits}f}{after}'


def methods_of(rows, task, mode, new_pixels=True, wanted=True):
    """
    List methods in the order of the tables.

    :param rows: of one scale.
    :param wanted: also those that a complete set of results has and these rows lack.
    """
    names = {row['method'] for row in rows if (row['task'], row['mode']) == (task, mode)
             and row.get('new_pixels', new_pixels) == new_pixels}
    if wanted and rows:
        names |= {run.label for run in paper_runs(rows[0]['scale'])
                  if (run.task, run.mode, run.new_pixels) == (task, mode, new_pixels)}
    return sorted(names, key=method_order)


def scores_table(rows, task, mode, new_pixels=True):
    """Write errors and match-steps of a task beside the paper's (Table 1)."""
    published = TABLE_1.get(task, {}) if mode == 'bidirectional' and new_pixels else {}
    lines = []
    for method in methods_of(rows, task, mode, new_pixels):
        if BEST in method:
            continue
        about = {'task': task, 'mode': mode, 'method': method, 'new_pixels': new_pixels}
        error = find(rows, **about, metric='min_l1')
        theirs = published.get(method, (None,) * 3)
        line = [method, NOT_RUN, *['-'] * 4]
        if error:
            step, spread, beside, changed = (find(rows, **about, metric=metric) for metric in (
                'match_step', 'match_step_std', 'match_beside_input', 'changed_l1'))
            line = [method, with_interval(error), with_interval(changed, 3),
                    f'{step["value"]:.1f} ± {spread["value"]:.1f}',
                    plain(beside['value'], 0, 100, '%'), str(error['seeds'])]
        if published:
            line += [plain(theirs[0]),
                     '-' if theirs[1] is None else f'{theirs[1]:.1f} ± {theirs[2]:.1f}']
        lines.append(line)
    header = ['method', 'min l1 (95% interval)', 'of changed pixels', 'match-step',
              'beside an input', 'seeds']
    return markdown(header + (['paper: min l1', 'match-step'] if published else []), lines)


def gains_table(rows, new_pixels=True):
    """Write how far errors are below fix's, and whether at the same match-step."""
    lines = []
    for task, title in TITLES.items():
        for method in methods_of(rows, task, 'bidirectional', new_pixels, wanted=False):
            about = {'task': task, 'mode': 'bidirectional', 'method': method,
                     'new_pixels': new_pixels}
            gain = find(rows, **about, metric='gain_over_fix')
            if gain is None or gain.get('new_pixels', True) != new_pixels:
                continue
            steps, share = (find(rows, **about, metric=f'{name}_minus_fix')
                            for name in ('match_step', 'match_fraction'))
            equal = '-' if share is None else 'yes' if abs(share['value']) <= EQUAL else 'no'
            theirs = GAINS.get(task) if method == 'genmin' and new_pixels else None
            same = find(rows, **about, metric='gain_over_fix_at_match_step')
            lines.append([title, method, gain['baseline'], with_interval(gain, 0, 100),
                          plain(theirs, 1, 100), with_interval(steps, 1, sign='+'), equal,
                          with_interval(same, 0, 100)])
    return lines and markdown(
        ['task', 'method', 'beside', 'error below fix, %', 'paper',
         'match-step minus that of fix, frames', 'equal',
         'error below fixed-time prediction at the same match-step, %'], lines, left=3)


def forward_table(rows, task='grasp'):
    """Write the numbers of the forward scatter (Fig. 4), and gains at the same match-step."""
    published = FORWARD_GRASP if task == 'grasp' else {}
    lines = []
    for method in methods_of(rows, task, 'forward'):
        if BEST in method:
            continue
        about = {'task': task, 'mode': 'forward', 'method': method, 'new_pixels': True}
        error, step, spread, gain = (find(rows, **about, metric=metric) for metric in (
            'min_l1', 'match_step', 'match_step_std', 'gain_over_fix_at_match_step'))
        line = [method, NOT_RUN, '-', '-']
        if error:
            line = [method, with_interval(error), f'{step["value"]:.1f} ± {spread["value"]:.1f}',
                    with_interval(gain, 0, 100)]
        theirs = published.get(method, (None, None))
        lines.append([*line, plain(theirs[1]), plain(theirs[0], 1)])
    return markdown(['method', 'min l1 (95% interval)', 'match-step',
                     'error below fix at this match-step, %', "authors': min l1", 'match-step'],
                    lines)


def bottleneck_table(rows, task):
    """Write the bottleneck frequency at every threshold in percent, and the median score."""
    lines = []
    for method in methods_of(rows, task, 'bidirectional', new_pixels=False):
        about = {'task': task, 'mode': 'bidirectional', 'method': method, 'new_pixels': False}
        shares = [find(rows, **about, metric=f'bottleneck_frequency_{threshold}px')
                  for threshold in THRESHOLDS]
        if BEST in method:
            continue
        if shares[0] is None:
            lines.append([method, NOT_RUN, *['-'] * (len(THRESHOLDS) + 2)])
            continue
        line = [method, *(plain(share['value'], 0, 100) for share in shares)]
        line[1 + 2] = f'**{line[1 + 2]}**'
        lines.append([
            *line, with_interval(find(rows, **about, metric='bottleneck_median_px'), 1),
            with_interval(find(rows, **about, metric='visible_bottleneck_frequency_2px'), 0, 100),
            with_interval(find(rows, **about, metric='target_bottleneck_frequency_2px'), 0, 100)])
    if task == 'push2':
        for method, share in BOTTLENECK_2PX.items():
            lines.append([f'{method} in the paper', *('-' if n != 2 else plain(share, 0, 100)
                                                            for n in THRESHOLDS), '-', '-', '-'])
    return markdown(['method', *(f'{n} px' for n in THRESHOLDS), 'median, px',
                     'no object left out, 2 px', 'the true frame at that time, 2 px'], lines)


def best_table(rows):
    """Write the best of 100 samples beside the lowest of the deterministic methods."""
    lines = []
    for task, title in TITLES.items():
        for new_pixels in (True, False):
            for of in methods_of(rows, task, 'bidirectional', new_pixels):
                if '-vae' not in of or BEST in of:
                    continue
                about = {'task': task, 'mode': 'bidirectional', 'new_pixels': new_pixels}
                method = best_of_name(of)
                best = find(rows, **about, method=method, metric='min_l1')
                lowest = lowest_deterministic(rows, task, new_pixels)
                spreads = [find(rows, **about, method=of, metric=f'sample_spread_{where}')
                           for where in ('near', 'elsewhere')]
                theirs = TABLE_1.get(task, {}).get(method, (None,))[0] if new_pixels else None
                lines.append([title, method, of + ('' if new_pixels else ', no new pixels'),
                              with_interval(best) if best else NOT_RUN,
                              f'{lowest["method"]}: {lowest["value"]:.4f}' if lowest else '-',
                              *(plain(spread and spread['value']) for spread in spreads),
                              plain(theirs)])
    return lines and markdown(
        ['task', 'method', 'samples of', 'min l1 (95% interval)', 'lowest without VAE',
         'spread of the samples near the objects', 'elsewhere', 'paper'], lines, left=3)


def lowest_deterministic(rows, task, new_pixels=True):
    """Find the row of the trained method without VAE with the lowest error, or None."""
    candidates = [row for row in rows if row['metric'] == 'min_l1' and row['task'] == task
                  and row['mode'] == 'bidirectional' and row.get('new_pixels') == new_pixels
                  and '-vae' not in row['method']]
    return min(candidates, key=lambda row: row['value'], default=None)
