# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers from result files: means with intervals, and differences between paired scenes."""

import json
from pathlib import Path

import numpy as np
from tap_ros.evaluation.intervals import mean_interval
from tap_ros.evaluation.planning.methods import parse_method
from tap_ros.evaluation.planning.runs import read_results

BASELINES = ('direct', 'fix')
SUCCESS_CM = 5.0


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

    A difference is this method minus a baseline, over the scenes that both were run on, so that
    less than 0 is better: minus direct, minus fix, and minus the same method without options.
    Intervals are of 95%, by bootstrap over scenes.

    :param results: of load_results.
    :return: list of dicts.
    """
    rows = []
    for (task, name), (settings, scenes) in results.items():
        runs = [scenes[seed] for seed in sorted(scenes)]
        finals = [run['final_cm'] for run in runs]
        measured = [
            ('final_distance_cm', finals, {'standard_error': _short(standard_error(finals))}),
            ('success_5cm', [max(run['objects_cm']) < SUCCESS_CM for run in runs], {}),
            ('steps', [run['steps'] for run in runs], {}),
            ('plan_ms', [run['plan_ms'] for run in runs], {}),
            ('tracking_error_px', [run.get('tracking_error_px') for run in runs], {})]
        for baseline in dict.fromkeys((*BASELINES, name.split(':')[0])):
            other = results.get((task, baseline), (None, {}))[1]
            both = sorted(set(scenes) & set(other))
            if name not in (baseline, 'nothing') and both:
                gaps = [scenes[seed]['final_cm'] - other[seed]['final_cm'] for seed in both]
                measured.append(('final_distance_difference_cm', gaps, {'against': baseline}))
        for metric, values, more in measured:
            values = np.array([value for value in values if value is not None], float)
            if len(values):
                value, low, high = mean_interval(values)
                rows.append({
                    'task': task, 'method': name, 'metric': metric, 'value': _short(value),
                    'ci_low': _short(low), 'ci_high': _short(high), 'n': len(values),
                    'seeds': 1, 'first_scene': min(scenes), **more, **_how(name, settings),
                    'command': settings.get('command', '')})
    return rows


def _how(name, settings):
    """Say in what way a method was planned, for its rows."""
    method, planner = parse_method(name), settings['planner']
    return {
        'tracking': settings['object_pixels'], 'switch': method.switch,
        'recursion': method.recursion, 'samples': method.samples, 'maps': method.maps,
        'model': method.model, 'step_budget': settings['step_budget'],
        'planner_samples': planner['search']['num_samples'],
        'planner_iterations': planner['search']['num_iterations'],
        'replan_every': planner['replan_every']}


def standard_error(values):
    """Return the standard error of a mean; 0 for a single value."""
    values = np.asarray(values, float)
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def write_rows(path, rows):
    """Write planning.json, a row a line."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text('[\n' + ',\n'.join(json.dumps(row) for row in rows) + '\n]\n')


def _short(value):
    return round(float(value), 4)
