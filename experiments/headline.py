# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The chart of the README, from the data of docs/results.

    python -m experiments.headline
"""

from pathlib import Path

from experiments.paper.figures import COLOURS, INK, new_figure
from experiments.paper.published import BOTTLENECK_2PX, GAINS
from experiments.tables import find, FIX, OURS, PLANNING, PREDICTION, RELATIVE, RESULTS

CAPTION = ('whiskers: 95% intervals over episodes or scenes; '
           '"paper": as published, without intervals')
PAPER, FIXED, HERE = '#8c8c8c', COLOURS['fix'], COLOURS['ours']


def bars():
    """Return title -> group -> [(label, colour, value, low, high)], %; None is not known."""
    def percent(file, **wanted):
        found = find(RESULTS, file, **wanted)
        return [100 * found[name] for name in ('value', 'ci_low', 'ci_high')]

    def predicted(task, method, metric, new_pixels):
        return percent(PREDICTION, task=task, method=method, mode='bidirectional', metric=metric,
                       new_pixels=new_pixels)

    def succeeded(task, method):
        return percent(PLANNING, task=task, method=method, metric='success_5cm')

    def published(value):
        return ['paper', PAPER, 100 * value, None, None]

    error = {title: [published(GAINS[task]),
                     ['tap_ros', HERE, *predicted(task, OURS.format(''), 'gain_over_fix', True)]]
             for task, title in (('grasp', 'grasp'), ('pick_place', 'pick and\nplace'),
                                 ('push2', 'push'))}
    at = 'bottleneck_frequency_2px'
    found = {'paper': [['fixed time', FIXED, 100 * BOTTLENECK_2PX['fix'], None, None],
                       ['paper', PAPER, 100 * BOTTLENECK_2PX['genmin'], None, None]]}
    for task, title in (('push2', 'usual\nrecordings'), ('push2_late', 'late\nbottlenecks')):
        found[title] = [['fixed time', FIXED, *predicted(task, FIX, at, False)],
                        ['tap_ros', HERE, *predicted(task, RELATIVE, at, False)]]
    success = {
        title: [*([] if 'late' in fix else [['direct', PAPER, *succeeded(task, 'direct')]]),
                ['fixed time', FIXED, *succeeded(task, fix)],
                ['tap_ros', HERE, *succeeded(task, ours)]]
        for task, title, fix, ours in (
            ('order2', 'two in\norder, late', 'fix+late', 'genmin+relative+late'),
            ('order2', 'two in\norder', 'fix', 'shipped'),
            ('order3', 'three in\norder', 'fix+rounds:rounds2', 'shipped:rounds2'),
            ('push2', 'two\nanywhere', 'fix', 'shipped'))}
    return {'error reduction vs. a fixed time, %': error, 'bottlenecks found, %': found,
            'planning succeeds, %': success}


def draw(path):
    """Draw the chart into a PNG file."""
    figure, axes = new_figure(2.7, 3)
    figure.supxlabel(CAPTION, fontsize=8, color=INK)
    for axis, (title, groups) in zip(axes[0], bars().items(), strict=True):
        place, ticks = 0.0, []
        for group in groups.values():
            ticks.append(place + (len(group) - 1) / 2)
            for label, colour, value, low, high in group:
                error = None if low is None else [[value - low], [high - value]]
                axis.bar(place, value, 0.9, color=colour, yerr=error, capsize=2,
                         error_kw={'elinewidth': 0.8, 'ecolor': INK})
                inside = value > 35
                text = label if value else f'{label}: 0'
                axis.text(place, 2 if inside else (high or value) + 2, text, rotation=90,
                          ha='center', va='bottom', fontsize=7,
                          color='white' if inside else INK)
                place += 1
            place += 0.6
        axis.set_xticks(ticks, list(groups), fontsize=8)
        axis.set_ylim(0, 100)
        axis.set_title(title, fontsize=9, color=INK)
    figure.savefig(path, dpi=110)


if __name__ == '__main__':
    draw(Path(__file__).parents[1] / 'docs' / 'images' / 'results.png')
