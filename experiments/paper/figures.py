# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plot of bottlenecks over when they come, and what all plots share."""

import io

from experiments.paper.published import TIMED_TITLES
from experiments.paper.runs import OURS
from matplotlib.figure import Figure
import numpy as np

# Okabe and Ito's colours, which colour-blind readers tell apart.
COLOURS = {'fix': '#0072b2', 'min': '#e69f00', 'genmin': '#d55e00', 'ours': '#009e73'}
INK = '#333333'
_WIDTH = 9.0  # inches
# Methods in the plot of timing: what they are called there, colour, marker.
_TIMED = {'genmin-wo-gan+relative': ('genmin+relative', 'ours', 'o'),
          'genmin-wo-gan+progress': ('genmin+progress', 'ours', 's'),
          'genmin-wo-gan': ('genmin', 'genmin', 'o'), 'fix0.25-wo-gan': ('fix 0.25', 'fix', 'v'),
          'fix-wo-gan': ('fix 0.5', 'fix', 'o'), 'fix0.75-wo-gan': ('fix 0.75', 'fix', '^')}


def new_figure(height, columns, rows=1, **options):
    """Return an empty figure of this height in inches, and its axes (rows, columns)."""
    figure = Figure(figsize=(_WIDTH, height), layout='constrained')
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.spines[['top', 'right']].set_visible(False)
        axis.spines[['left', 'bottom']].set_color('#a0a0a0')
        axis.tick_params(colors=INK, labelsize=8, length=3)
        axis.set_axisbelow(True)
    return figure, axes


def to_png(figure):
    """Return a figure as bytes that depend on nothing but what it shows."""
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=110, metadata={'Software': None})
    return stream.getvalue()


def timing(rows):
    """Draw the bottleneck frequency over when it comes, of as_frame; None without such rows."""
    rows = rows[(rows['metric'] == 'bottleneck_frequency_2px') & rows['task'].isin(TIMED_TITLES)]
    if not len(rows):
        return None
    figure, ((axis,),) = new_figure(3.8, 1)
    for n, (method, (name, colour, marker)) in enumerate(_TIMED.items()):
        found = rows[rows['method'] == method + OURS].set_index('task').reindex(TIMED_TITLES)
        value, low, high = 100 * found[['value', 'ci_low', 'ci_high']].to_numpy().T
        at = np.arange(len(value)) + 0.05 * n
        axis.errorbar(at, value, [value - low, high - value], color=COLOURS[colour],
                      marker=marker, linestyle='none', label=name)
        axis.plot(at[:-1], value[:-1], color=COLOURS[colour], alpha=0.5)  # 'any' is no later time
    axis.set_xticks(range(len(TIMED_TITLES)), TIMED_TITLES.values())
    axis.set_ylim(-2, 102)
    axis.grid(axis='y', color='#f0f0f0')
    axis.set_xlabel('when the first object is home and the other untouched', color=INK)
    axis.set_ylabel('bottlenecks at 2 px, %', color=INK)
    axis.legend(loc='center left', bbox_to_anchor=(1, 0.5), frameon=False)
    return to_png(figure)
