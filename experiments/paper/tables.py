# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tables of the results page, as DataFrames of text.

Their rows are those of rows.as_frame, of one scale.
"""

from experiments.pages import interval, number
from experiments.paper.names import (
    BEST,
    best_of_name,
    COPIES,
    method_order,
    short_name,
    trained_as_long,
)
from experiments.paper.published import (
    BOTTLENECK_2PX,
    FORWARD_GRASP,
    GAINS,
    SHIFTED_TITLES,
    TABLE_1,
    TIMED_TITLES,
    TITLES,
)
from experiments.paper.rows import find, of_metric, select
from experiments.paper.runs import paper_runs
import pandas as pd
from tap_ros.evaluation.bottleneck import THRESHOLDS

NOT_RUN = '*not run*'
# Match-steps within this share of the episode are called equal; between fix and genmin the
# paper's own lie up to 0.11 apart.
EQUAL = 0.10


def _methods_of(rows, task, mode, new_pixels):
    """List, in order, the methods of a setting and those that complete results have."""
    names = {*select(rows, task, mode, new_pixels)['method'], *(
        run.label for scale in rows['scale'].unique() for run in paper_runs(scale)
        if (run.task, run.mode, run.new_pixels) == (task, mode, new_pixels))}
    return sorted((name for name in names if BEST not in name), key=method_order)


def _match_steps(own, methods):
    """Write the mean match-steps and their standard deviations."""
    mean, spread = (number(of_metric(own, metric, methods)['value'], 1)
                    for metric in ('match_step', 'match_step_std'))
    return mean + ' ± ' + spread


def scores_table(rows, task, mode, new_pixels=True):
    """Show errors and match-steps of a task beside the paper's (Table 1)."""
    own = select(rows, task, mode, new_pixels)
    methods = _methods_of(rows, task, mode, new_pixels)
    error, changed, beside = (of_metric(own, metric, methods) for metric in (
        'min_l1', 'changed_l1', 'match_beside_input'))
    table = pd.DataFrame({
        'min l1 (95% interval)': interval(error).fillna(NOT_RUN),
        'of changed pixels': interval(changed, 3),
        'match-step': _match_steps(own, methods),
        'beside an input': number(beside['value'], 0, 100) + '%'})
    shown = of_metric(own, 'shows_both', methods)
    if shown['value'].notna().any():
        table['shows hand and objects, %'] = interval(shown, 0, 100)
    table['by seed'] = error['by_seed'].map(_by_seed)
    if mode == 'bidirectional' and new_pixels and task in TABLE_1:
        theirs = pd.DataFrame.from_dict(
            TABLE_1[task], 'index', columns=['l1', 'step', 'std']).reindex(methods)
        table['paper: min l1'] = number(theirs['l1'])
        table['paper: match-step'] = number(theirs['step'], 1) + ' ± ' + number(theirs['std'], 1)
    return table.rename_axis('method').reset_index()


def _by_seed(values):
    """Write the values of several seeds."""
    several = isinstance(values, list) and len(values) > 1
    return ' '.join(f'{value:.4f}' for value in values) if several else None


def gains_table(rows, new_pixels=True):
    """Show how far errors are below fix's, and whether at the same match-step; may be empty."""
    parts = []
    for task, title in TITLES.items():
        own = select(rows, task, 'bidirectional', new_pixels)
        own = own[own['new_pixels'].fillna(True) == new_pixels]  # copying: once
        methods = sorted(own['method'][own['metric'] == 'gain_over_fix'], key=method_order)
        gain, steps, share, same = (of_metric(own, metric, methods) for metric in (
            'gain_over_fix', 'match_step_minus_fix', 'match_fraction_minus_fix',
            'gain_over_fix_at_match_step'))
        paper = pd.Series({'genmin': GAINS.get(task) if new_pixels else None}, methods, float)
        near = share['value'].abs() <= EQUAL
        parts.append(pd.DataFrame({
            'task': title, 'method': gain.index, 'beside': gain['baseline'],
            'error below fix, %': interval(gain, 0, 100), 'paper': number(paper, 1, 100),
            'match-step minus that of fix, frames': interval(steps, 1, sign='+'),
            'equal': near.map({True: 'yes', False: 'no'}).where(share['value'].notna()),
            'error below fixed-time prediction at the same match-step, %':
                interval(same, 0, 100)}))
    return pd.concat(parts)


def forward_table(rows, task='grasp'):
    """Show the numbers of the forward scatter (Fig. 4), and gains at the same match-step."""
    own = select(rows, task, 'forward')
    methods = _methods_of(rows, task, 'forward', True)
    theirs = pd.DataFrame.from_dict(FORWARD_GRASP if task == 'grasp' else {}, 'index',
                                    columns=['step', 'l1']).reindex(map(short_name, methods))
    theirs.index = methods
    return pd.DataFrame({
        'min l1 (95% interval)': interval(of_metric(own, 'min_l1', methods)).fillna(NOT_RUN),
        'match-step': _match_steps(own, methods),
        'error below fix at this match-step, %': interval(
            of_metric(own, 'gain_over_fix_at_match_step', methods), 0, 100),
        "authors': min l1": number(theirs['l1']),
        "authors': match-step": number(theirs['step'], 1)}).rename_axis('method').reset_index()


def bottleneck_table(rows, task):
    """Show the bottleneck frequency at every threshold in percent, and the median score."""
    own = select(rows, task, 'bidirectional', new_pixels=False)
    methods = _methods_of(rows, task, 'bidirectional', False)
    table = pd.DataFrame({f'{n} px': number(of_metric(
        own, f'bottleneck_frequency_{n}px', methods)['value'], 0, 100) for n in THRESHOLDS})
    table['2 px'] = '**' + table['2 px'] + '**'
    table['0 px'] = table['0 px'].fillna(NOT_RUN)
    table['median, px'] = interval(of_metric(own, 'bottleneck_median_px', methods), 1)
    table['no object left out, 2 px'] = interval(
        of_metric(own, 'visible_bottleneck_frequency_2px', methods), 0, 100)
    table['the true frame at that time, 2 px'] = interval(
        of_metric(own, 'target_bottleneck_frequency_2px', methods), 0, 100)
    if task == 'push2':
        theirs = number(pd.Series(BOTTLENECK_2PX), 0, 100)
        table = pd.concat([table, theirs.add_suffix(' in the paper').to_frame('2 px')])
    return table.rename_axis('method').reset_index()


def best_table(rows):
    """Show the best of 100 samples beside the lowest of the other methods; may be empty."""
    parts = []
    for task, title in TITLES.items():
        for new_pixels in (True, False):
            own = select(rows, task, 'bidirectional', new_pixels)
            drawn = [method for method in _methods_of(rows, task, 'bidirectional', new_pixels)
                     if '-vae' in method]
            best = [best_of_name(method) for method in drawn]
            lowest = lowest_deterministic(rows, task, new_pixels)
            paper = {name: scores[0] for name, scores in TABLE_1.get(task, {}).items()}
            near, elsewhere = (number(of_metric(own, f'sample_spread_{where}', drawn)['value'])
                               for where in ('near', 'elsewhere'))
            parts.append(pd.DataFrame({
                'task': title, 'method': best,
                'samples of': [of + ('' if new_pixels else ', no new pixels') for of in drawn],
                'min l1 (95% interval)': interval(
                    of_metric(own, 'min_l1', best)).fillna(NOT_RUN).array,
                'lowest without VAE': lowest and f'{lowest["method"]}: {lowest["value"]:.4f}',
                'spread of the samples near the objects': near.array,
                'elsewhere': elsewhere.array,
                'paper': number(pd.Series(paper if new_pixels else {}, best, float)).array}))
    return pd.concat(parts)


def lowest_deterministic(rows, task, new_pixels=True):
    """
    Find the trained method without VAE that has the lowest error.

    :return: its row as a dict, or None. Methods that were trained for longer do not count.
    """
    own = select(rows, task, 'bidirectional', new_pixels)
    own = own[(own['metric'] == 'min_l1') & ~own['method'].str.contains('-vae')
              & ~own['method'].isin(COPIES) & own['method'].map(trained_as_long).astype(bool)]
    return None if own.empty else own.loc[own['value'].idxmin()].to_dict()


def lowest_best(rows, task):
    """Find the row (dict) of the best of 100 samples with the lowest error, or None."""
    own = select(rows, task, 'bidirectional')
    own = own[(own['metric'] == 'min_l1') & own['method'].str.contains(BEST)]
    return None if own.empty else own.loc[own['value'].idxmin()].to_dict()


def gain_of_best(rows, best):
    """Find the row (dict) that says how far the best of 100 is below the lowest without VAE."""
    return find(rows, metric='gain_over_deterministic',
                **{name: best[name] for name in ('task', 'mode', 'method', 'new_pixels')})


def timing_table(rows):
    """Show bottlenecks of methods on recordings whose bottleneck comes at other times."""
    parts = []
    for task, title in TIMED_TITLES.items():
        own = select(rows, task, 'bidirectional', new_pixels=False)
        methods = [name for name in _methods_of(rows, task, 'bidirectional', False)
                   if name not in COPIES]
        at, found, target = (of_metric(own, metric, methods) for metric in (
            'bottleneck_at', 'bottleneck_frequency_2px', 'target_bottleneck_frequency_2px'))
        parts.append(pd.DataFrame({
            'the bottleneck comes': title, 'at, share of the episode': number(at['value'], 2),
            'method': methods,
            'bottlenecks at 2 px, %': interval(found, 0, 100).fillna(NOT_RUN),
            'no object left out, %': interval(
                of_metric(own, 'visible_bottleneck_frequency_2px', methods), 0, 100),
            'the true frame at that time, %': number(target['value'], 0, 100),
            'match, share of the episode': number(
                of_metric(own, 'match_fraction', methods)['value'], 2)}))
    return pd.concat(parts)


def shift_table(rows):
    """Show what other looks of pushing change, for the methods that were scored on them."""
    parts = []
    for task, title in SHIFTED_TITLES.items():
        own = select(rows, task, 'bidirectional', new_pixels=False)
        methods = [name for name in sorted(set(own['method']), key=method_order)
                   if name in COPIES or name.endswith('+skips')]
        parts.append(pd.DataFrame({
            'pictures': title, 'method': methods,
            'bottlenecks at 2 px, %': interval(
                of_metric(own, 'bottleneck_frequency_2px', methods), 0, 100),
            'min l1 (95% interval)': interval(of_metric(own, 'min_l1', methods))}))
    return pd.concat(parts)


def recursion_table(rows):
    """Show how often r = 1 is the place, and then r = 2 the pick (Fig. 7); may be empty."""
    parts = []
    for task in ('pick_place', 'stack2'):
        own = select(rows, task, 'bidirectional')
        methods = sorted(set(own['method'][own['metric'] == 'place']), key=method_order)
        parts.append(pd.DataFrame({
            'task': TITLES[task], 'method': methods, **{
                title: interval(of_metric(own, metric, methods), 0, 100) for title, metric in (
                    ('r = 1 is the place, %', 'place'),
                    ('of these r = 2 is the pick, %', 'pick_after_place'),
                    ('and shows hand and objects, %', 'pick_after_place_shown'))}}))
    return pd.concat(parts)


def parts_table(rows, task='push2'):
    """Show what each part of genmin+progress is worth: bottlenecks with and without it."""
    own = select(rows, task, 'bidirectional', new_pixels=False)
    methods = [name for name in _methods_of(rows, task, 'bidirectional', False)
               if name.startswith('genmin')]
    return pd.DataFrame({
        'method': methods, 'bottlenecks at 2 px, %': interval(
            of_metric(own, 'bottleneck_frequency_2px', methods), 0, 100).fillna(NOT_RUN).array,
        'match, share of the episode': number(
            of_metric(own, 'match_fraction', methods)['value'], 2).array,
        'beside an input, %': number(
            of_metric(own, 'match_beside_input', methods)['value'], 0, 100).array,
        'seeds': number(of_metric(own, 'min_l1', methods)['seeds'], 0).array})
