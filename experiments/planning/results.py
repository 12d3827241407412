# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers from result files: means with intervals, and differences between paired scenes."""

from dataclasses import replace
from pathlib import Path

from experiments.planning.methods import BASES, DEFAULTS, parse_method, SUBGOALS_ONLY
from experiments.planning.runs import read_results
import pandas as pd
from scipy.stats import sem
from tap_ros.contract import SUCCESS_DISTANCE
from tap_ros.evaluation.intervals import mean_interval

# Results are compared where these settings agree; what an option changes is not among them.
SAME = ('look', 'step_budget', 'reached_px', 'preset', 'forward_weights', 'device', 'precision')


def load_results(folder):
    """
    Read all result files of a folder.

    :return: dict (task, method name) -> (settings, scenes by seed).
    :raises ConfigError: if one is damaged.
    """
    found = {}
    for path in sorted(Path(folder).glob('*.json')):
        settings, scenes = read_results(path)
        if scenes:
            found[settings['task'], settings['method']] = settings, scenes
    return found


def make_rows(results):
    """
    Turn results into the rows of planning.json.

    A difference is this method minus another, over the scenes that both were run on, so that less
    than 0 cm, or more than 0 of success, is better; see partners. Intervals are of 95%, by
    bootstrap over scenes.

    :param results: of load_results.
    :return: list of dicts.
    """
    rows, names = [], {}
    tables = {key: _table(scenes) for key, (_, scenes) in results.items()}
    for task, name in results:
        names.setdefault(task, set()).add(name)
    for (task, name), (settings, scenes) in results.items():
        mine = tables[task, name]
        measured = [
            ('final_distance_cm', mine['final_cm'],
             {'standard_error': _short(standard_error(mine['final_cm']))}),
            ('success_5cm', mine['success'], {}), ('steps', mine['steps'], {}),
            ('plan_ms', mine['plan_ms'], {}),
            ('tracking_error_px', mine['tracking_error_px'], {})]
        for compares, partner in partners(parse_method(name), names[task]):
            if comparable(compares, settings, results[task, partner][0]):
                about = {'against': partner, 'compares': compares}
                gaps = mine - tables[task, partner]  # NaN for scenes that only one has
                measured += [('final_distance_difference_cm', gaps['final_cm'], about),
                             ('success_5cm_difference', gaps['success'], about)]
        for metric, values, more in measured:
            values = values.dropna()
            if len(values):
                value, low, high = mean_interval(values)
                rows.append({
                    'task': task, 'method': name, 'metric': metric, 'value': _short(value),
                    'ci_low': _short(low), 'ci_high': _short(high), 'n': len(values),
                    'seeds': 1, 'first_scene': min(scenes), **more, **_how(name, settings),
                    'command': settings.get('command', '')})
    return rows


def _table(scenes):
    """Return a line of numbers for each scene, by seed; success is 1 or 0."""
    table = pd.DataFrame.from_dict(scenes, 'index').sort_index()
    table['success'] = table['objects_cm'].map(max) < 100 * SUCCESS_DISTANCE
    return table.reindex(columns=[
        'final_cm', 'success', 'steps', 'plan_ms', 'tracking_error_px']).astype(float)


def comparable(compares, settings, others):
    """
    Say whether two results differ in nothing but what is compared.

    :param compares: of partners.
    :param settings: of one result; others: of the other.
    """
    same = all(settings[key] == others[key] for key in SAME if key != compares)
    # These are settings of the planner.
    if compares not in ('direct, twice', 'search', 'cost', 'replan_every'):
        same &= settings['planner'] == others['planner']
    bases = [parse_method(about['method']).base for about in (settings, others)]
    if bases[0] == bases[1]:
        same &= settings['predictor_weights'] == others['predictor_weights']
    return same


def partners(method, names):
    """
    Say which methods one is compared with: those that differ in one part only.

    :param method: Method.
    :param names: of all methods that there are results of.
    :return: list of (what is compared, name of the other): 'direct' and 'fix' with the same
        planner (fix with the same switch, recursion and rounds, too, and trained likewise where
        there are results of that, see _fixed_time), direct with twice the samples; for each
        option the method without it, under the name of Method's field; for true_subgoal every
        predictor, as 'subgoal'.
    """
    if method.base == 'nothing':
        return []
    plain = {field: DEFAULTS[field] for field in SUBGOALS_ONLY}
    once = {field: DEFAULTS[field] for field in ('samples', 'maps')}
    found = [('direct', replace(method, base='direct', **plain))]
    if not method.base.startswith('fix'):
        fixed = [replace(method, base=base, **once) for base in _fixed_time(method)]
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


def _fixed_time(method):
    """Name the predictors of fixed time that a method is compared with: trained likewise, any."""
    likewise = method.base.rpartition('+')[2]
    if method.base == 'shipped' and method.rounds > 1:
        likewise = 'rounds'
    return [f'fix+{likewise}', 'fix']


def _how(name, settings):
    """Say in what way a method was planned, for its rows."""
    method, planner = parse_method(name), settings['planner']
    return {
        'look': settings['look'], 'tracking': settings['object_pixels'], 'switch': method.switch,
        'recursion': method.recursion, 'rounds': method.rounds, 'samples': method.samples,
        'maps': method.maps, 'model': method.model, 'cost': method.cost,
        'step_budget': settings['step_budget'],
        'planner_samples': planner['search']['num_samples'],
        'planner_iterations': planner['search']['num_iterations'],
        'replan_every': planner['replan_every'], 'preset': settings['preset'],
        'device': settings['device'], 'precision': settings['precision']}


def standard_error(values):
    """Return the standard error of a mean; 0 for a single value."""
    return float(sem(values)) if len(values) > 1 else 0.0


def _short(value):
    return round(float(value), 4)
