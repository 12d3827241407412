# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plot of bottlenecks over when they come, and what all plots share."""

import io

from experiments.paper.names import COPIES, method_order, short_name
from experiments.paper.published import TIMED_TITLES
from experiments.paper.rows import select
from experiments.paper.runs import OURS
from matplotlib.figure import Figure
import numpy as np

# Okabe and Ito's colours, which colour-blind readers tell apart; one for each family of methods.
COLOURS = {'copy': '#8c8c8c', 'fix': '#0072b2', 'min': '#e69f00', 'genmin': '#d55e00',
           'ours': '#009e73', 'vae': '#cc79a7'}
INK = '#333333'
_WIDTH = 9.0  # inches


def family(method):
    """
    Say which family a method belongs to, a key of COLOURS.

    :param method: its name; a form that is not in the paper ('+...') is of 'ours', whatever the
        network.
    """
    if method in COPIES:
        return 'copy'
    if '+' in method.removesuffix(OURS):
        return 'ours'
    if '-vae' in method:
        return 'vae'
    return next(name for name in ('fix', 'min', 'genmin') if method.startswith(name))


def new_figure(height, columns, rows=1, **options):
    """Return an empty figure of this height in inches, and its axes (rows, columns)."""
    figure = Figure(figsize=(_WIDTH, height), layout='constrained')
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        for side in ('top', 'right'):
            axis.spines[side].set_visible(False)
        for side in ('left', 'bottom'):
            axis.spines[side].set_color('#a0a0a0')
        axis.tick_params(colors=INK, labelsize=8, length=3)
        axis.set_axisbelow(True)
    return figure, axes


def to_png(figure):
    """Return a figure as bytes that depend on nothing but what it shows."""
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=110, metadata={'Software': None})
    return stream.getvalue()


def _spread(positions, gap):
    """Move positions apart along a line until neighbours are `gap` apart; keeps the order."""
    order = np.argsort(positions, kind='stable')
    moved = np.array(positions, float)[order]
    for _ in range(200):
        short = gap - np.diff(moved)
        if (short <= 1e-9).all():
            break
        push = np.where(short > 0, short / 2, 0)
        moved[:-1] -= push
        moved[1:] += push
    result = np.empty_like(moved)
    result[order] = moved
    return result


def timing(rows):
    """
    Draw the bottleneck frequency of methods over when the bottleneck comes.

    :param rows: of rows.as_frame.
    :return: bytes of a PNG, or None without such rows.
    """
    found = {}
    for at, task in enumerate(TIMED_TITLES):
        own = select(rows, task, 'bidirectional', new_pixels=False)
        own = own[own['metric'] == 'bottleneck_frequency_2px']
        # Longer trainings stand in the table: they were not made of every recording.
        left_out = own['method'].isin(COPIES) | own['method'].str.endswith('+long')
        for row in own[~left_out].to_dict('records'):
            found.setdefault(row['method'], []).append(
                (at, *(100 * row[name] for name in ('value', 'ci_low', 'ci_high'))))
    if not found:
        return None
    figure, axes = new_figure(3.8, 1)
    axis, methods = axes[0, 0], sorted(found, key=method_order)
    styles = _line_styles(methods)
    for n, method in enumerate(methods):
        at, value, low, high = np.array(found[method]).T
        at, colour = at + 0.04 * (n - (len(methods) - 1) / 2), COLOURS[family(method)]
        axis.errorbar(at, value, [value - low, high - value], color=colour, fmt='none', alpha=0.5)
        axis.plot(at, value, 'o', color=colour, markeredgecolor='white')
        timed = at < len(TIMED_TITLES) - 1.5  # 'any' is no later time
        axis.plot(at[timed], value[timed], linestyle=styles[method], color=colour)
    ends = {method: found[method][-1][1] for method in methods}
    for method, y in zip(methods, _spread(list(ends.values()), 5.0)):
        axis.plot([3.3, 3.42], [y, y], linestyle=styles[method], color=COLOURS[family(method)],
                  clip_on=False)
        axis.annotate(short_name(method), (3.46, y), fontsize=8.5, va='center',
                      color=COLOURS[family(method)], annotation_clip=False)
    axis.set(xlim=(-0.3, 3.3), ylim=(-2, 102))
    axis.set_xticks(range(len(TIMED_TITLES)), TIMED_TITLES.values())
    axis.grid(axis='y', color='#f0f0f0')
    axis.set_xlabel('when the first object is home and the other untouched', fontsize=9,
                    color=INK)
    axis.set_ylabel('bottlenecks at 2 px, %', fontsize=9, color=INK)
    axis.set_title('Pushing two objects: whether the time has to be known', fontsize=10,
                   loc='left', color=INK)
    return to_png(figure)


def _line_styles(methods):
    """Tell methods of one family apart by the line: method -> style."""
    styles, used = {}, {}
    for method in sorted(methods, key=method_order):
        number = used[family(method)] = used.get(family(method), -1) + 1
        order = ('--', ':') if family(method) == 'copy' else (
            '-', '--', '-.', ':', (0, (6, 1, 1, 1, 1, 1)))
        styles[method] = order[number % len(order)]
    return styles
