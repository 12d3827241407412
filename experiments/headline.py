# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The chart of the README, from the data of docs/results.

    python -m experiments.headline
"""

import json
from pathlib import Path

from experiments.paper.figures import COLOURS, INK, new_figure
from experiments.paper.published import BOTTLENECK_2PX, GAINS
import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
OURS = 'genmin-wo-gan+skips'
RELATIVE, FIX = 'genmin-wo-gan+relative+skips', 'fix-wo-gan+skips'
PAPER, FIXED, HERE = '#8c8c8c', COLOURS['fix'], COLOURS['ours']


def load():
    """Return the rows of prediction.csv and planning.json, both as DataFrames."""
    results = ROOT / 'docs' / 'results'
    return (pd.read_csv(results / 'prediction.csv'),
            pd.DataFrame(json.loads((results / 'planning.json').read_text())))


def bars():
    """
    Return what is drawn: title -> group -> [(label, colour, value, low, high)], in percent.

    Low and high are 95% intervals; None where none is known.
    """
    prediction, planning = load()

    def predicted(task, method, metric, new_pixels):
        found = prediction[(prediction.task == task) & (prediction.method == method)
                           & (prediction['mode'] == 'bidirectional')
                           & (prediction.metric == metric)
                           & (prediction.new_pixels == new_pixels)].iloc[0]
        return [100 * found[name] for name in ('value', 'ci_low', 'ci_high')]

    def succeeded(task, method):
        found = planning[(planning.task == task) & (planning.method == method)
                         & (planning.metric == 'success_5cm')].iloc[0]
        return [100 * found[name] for name in ('value', 'ci_low', 'ci_high')]

    def published(value):
        return ['paper', PAPER, 100 * value, None, None]

    error = {title: [published(GAINS[task]),
                     ['here', HERE, *predicted(task, OURS, 'gain_over_fix', True)]]
             for task, title in (('grasp', 'grasp'), ('pick_place', 'pick and\nplace'),
                                 ('push2', 'push'))}
    at = 'bottleneck_frequency_2px'
    found = {'paper': [['fixed time', FIXED, 100 * BOTTLENECK_2PX['fix'], None, None],
                       ['paper', PAPER, 100 * BOTTLENECK_2PX['genmin'], None, None]]}
    for task, title in (('push2', 'usual\nrecordings'), ('push2_late', 'late\nbottlenecks')):
        found[title] = [['fixed time', FIXED, *predicted(task, FIX, at, False)],
                        ['here', HERE, *predicted(task, RELATIVE, at, False)]]
    success = {
        title: [['direct', PAPER, *succeeded(task, 'direct')],
                ['fixed time', FIXED, *succeeded(task, fix)],
                ['here', HERE, *succeeded(task, ours)]]
        for task, title, fix, ours in (
            ('order2', 'two in order', 'fix', 'shipped'),
            ('order3', 'three in order', 'fix+rounds:rounds2', 'shipped:rounds2'))}
    return {"error below a fixed time's, %": error, 'bottlenecks found, %': found,
            'planning succeeds, %': success}


def draw(path):
    """Draw the chart into a PNG file."""
    figure, axes = new_figure(2.5, 3)
    for axis, (title, groups) in zip(axes[0], bars().items(), strict=True):
        place, ticks = 0.0, []
        for group in groups.values():
            ticks.append(place + (len(group) - 1) / 2)
            for label, colour, value, low, high in group:
                error = None if low is None else [[value - low], [high - value]]
                axis.bar(place, value, 0.9, color=colour, yerr=error, capsize=2,
                         error_kw={'elinewidth': 0.8, 'ecolor': INK})
                inside = value > 35
                axis.text(place, 2 if inside else (high or value) + 2, label, rotation=90,
                          ha='center', va='bottom', fontsize=7,
                          color='white' if inside else INK)
                place += 1
            place += 0.6
        axis.set_xticks(ticks, list(groups), fontsize=8)
        axis.set_ylim(0, 100)
        axis.set_title(title, fontsize=9, color=INK)
    figure.savefig(path, dpi=110)


if __name__ == '__main__':
    draw(ROOT / 'docs' / 'images' / 'results.png')
