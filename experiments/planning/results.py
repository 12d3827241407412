# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers from result files: means with intervals, and differences between paired scenes."""

from dataclasses import replace

from experiments.planning.methods import BASES, DEFAULTS, parse_method, SUBGOALS_ONLY
import pandas as pd
from scipy.stats import sem
from tap_ros.base.contract import SUCCESS_DISTANCE
from tap_ros.evaluation.intervals import mean_interval, share_interval

# Results are compared where these settings agree; what an option changes is not among them.
SAME = ('look', 'step_budget', 'reached_px', 'preset', 'forward_weights', 'device', 'precision')
SHARES = ('success', 'first_right')  # of stacking
MEANS = ('moves', 'final_cm', 'steps', 'seconds')
ABOUT = ('look', 'device', 'object_places', 'predictor_weights', 'command', 'date', 'machine',
         'version')


def make_rows(results):
    """
    Turn results of pushing into the rows of planning.json.

    A difference is this method minus another, over the scenes that both were run on, so that less
    than 0 cm, or more than 0 of success, is better; see partners.
    """
    rows, names, tables = [], {}, {}
    for (task, name), (_, scenes) in results.items():
        names.setdefault(task, set()).add(name)
        table = pd.DataFrame.from_dict(scenes, 'index').sort_index()
        table['success'] = table['objects_cm'].map(max) < 100 * SUCCESS_DISTANCE
        tables[task, name] = table.reindex(columns=[
            'final_cm', 'success', 'steps', 'plan_ms', 'tracking_error_px']).astype(float)
    for (task, name), (settings, scenes) in results.items():
        mine, method = tables[task, name], parse_method(name)
        error = float(sem(mine['final_cm'])) if len(mine) > 1 else 0.0
        measured = [
            ('final_distance_cm', mine['final_cm'], {'standard_error': round(error, 4)}),
            ('success_5cm', mine['success'], {}), ('steps', mine['steps'], {}),
            ('plan_ms', mine['plan_ms'], {}),
            ('tracking_error_px', mine['tracking_error_px'], {})]
        for compares, partner in partners(method, names[task]):
            if comparable(compares, settings, results[task, partner][0]):
                about = {'against': partner, 'compares': compares}
                gaps = mine - tables[task, partner]  # NaN for scenes that only one has
                measured += [('final_distance_difference_cm', gaps['final_cm'], about),
                             ('success_5cm_difference', gaps['success'], about)]
        planner = settings['planner']
        how = {'look': settings['look'], 'tracking': settings['object_pixels'],
               **{key: getattr(method, key) for key in (
                   'switch', 'recursion', 'rounds', 'samples', 'model')},
               'step_budget': settings['step_budget'],
               'planner_samples': planner['search']['num_samples'],
               'planner_iterations': planner['search']['num_iterations'],
               **{key: settings[key] for key in ('preset', 'device', 'precision')},
               'command': settings.get('command', '')}
        rows += [_row(task, name, metric, mean_interval(values), len(values),
                      seeds=1, first_scene=min(scenes), **more, **how)
                 for metric, values, more in (
                     (metric, values.dropna(), more) for metric, values, more in measured)
                 if len(values)]
    return rows


def make_stack_rows(results):
    """Turn results of stacking into the rows of stacking.json; shares have Wilson's intervals."""
    rows = []
    tables = {key: pd.DataFrame.from_dict(scenes, 'index').sort_index()[
        [*SHARES, *MEANS]].astype(float) for key, (_, scenes) in results.items()}
    for (task, name), (settings, scenes) in results.items():
        mine = tables[task, name]
        measured = [(metric, share_interval(mine[metric]), len(mine), {}) for metric in SHARES]
        measured += [(metric, mean_interval(mine[metric]), len(mine), {}) for metric in MEANS]
        for other in ('direct', 'lowest_first', 'fix'):
            if other == name or (task, other) not in results or any(
                    settings[key] != results[task, other][0][key] for key in ('look', 'device')):
                continue
            gaps = (mine['success'] - tables[task, other]['success']).dropna()  # of both
            if len(gaps):
                measured.append(('success_difference', mean_interval(gaps), len(gaps),
                                 {'against': other}))
        rows += [_row(task, name, metric, found, count, first_scene=min(scenes), **more,
                      **{key: settings.get(key) for key in ABOUT})
                 for metric, found, count, more in measured]
    return rows


def _row(task, name, metric, found, count, **more):
    value, low, high = (round(float(part), 4) for part in found)
    return {'task': task, 'method': name, 'metric': metric, 'value': value, 'ci_low': low,
            'ci_high': high, 'n': count, **more}


def comparable(compares, settings, others):
    """Return whether the settings of two results differ in nothing but what is compared."""
    same = all(settings[key] == others[key] for key in SAME if key != compares)
    if compares not in ('direct, twice', 'search'):  # these are settings of the planner
        same &= settings['planner'] == others['planner']
    bases = [parse_method(about['method']).base for about in (settings, others)]
    if bases[0] == bases[1]:
        same &= settings['predictor_weights'] == others['predictor_weights']
    return same


def partners(method, names):
    """
    Return [(what is compared, name)] of those that differ from a method in one part only.

    'direct' and 'fix' with the same planner (fix with the same switch, recursion and rounds, too,
    and trained likewise where there are results of that), direct with twice the samples; for each
    option the method without it; for true_subgoal every predictor, as 'subgoal'.
    """
    if method.base == 'nothing':
        return []
    plain = {field: DEFAULTS[field] for field in SUBGOALS_ONLY}
    found = [('direct', replace(method, base='direct', **plain))]
    if not method.base.startswith('fix'):
        likewise = method.base.rpartition('+')[2]
        if method.base == 'shipped' and method.rounds > 1:
            likewise = 'rounds'
        fixed = [replace(method, base=base, samples=1) for base in (f'fix+{likewise}', 'fix')]
        found += [('fix', fix) for fix in fixed if fix.name in names][:1]
    if method.search == 'preset' and method.base != 'direct':
        found.append(('direct, twice', replace(method, base='direct', search='twice', **plain)))
    found += [(field, replace(method, **{field: default})) for field, default in DEFAULTS.items()
              if field != 'base' and getattr(method, field) != default]
    if method.base == 'true_subgoal':
        predictors = {parse_method(name).base for name in names} - set(BASES)
        found += [('subgoal', replace(method, base=base)) for base in sorted(predictors)]
    return [(what, other.name) for what, other in found
            if other.name in names and other != method]
