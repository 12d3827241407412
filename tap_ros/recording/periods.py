# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How long commands last: they are m/s for a period that is told, metres in older recordings."""

from collections.abc import Mapping, Sequence
import warnings

import numpy as np
from tap_ros.base.contract import CONTROL_PERIOD
from tap_ros.base.errors import RecordingWarning
from tap_ros.messages import topics
from tap_ros.recording.columns import Columns, Track

NAME = topics.CONTROL_PERIOD.recorded


def command_units(parts: Sequence[Columns], tracks: Mapping[str, Track], gaps: np.ndarray,
                  rows: np.ndarray, before: float | None = None) -> np.ndarray:
    """
    Return what commands are multiplied by, (N, 1), so that they are metres.

    It is the period told last, for the commands before the first one that one. What is not
    certain is warned of.

    :param parts: files that follow each other; tracks: of all of them.
    :param gaps: (G, 2) as defects.gaps, where messages are lost.
    :param rows: (N,) of the commands, in tracks['twist'].
    :param before: s, that earlier files of the bag told last, or None.
    """
    period, twist = tracks['period'], tracks['twist']
    told, doubt = period.picked()[:, 0], ''
    if not any('period' in part.topics for part in parts):
        if len(rows) and len(gaps) and gaps[:, 0].min() < twist.log.min():
            doubt = (f'a damaged part may have held {NAME}; commands count as metres in a '
                     'control period; if they were m/s, do not train on them')
        first = 1.0
    elif before is not None:
        first = before
    elif len(told):
        first = told[0]
    else:
        first = CONTROL_PERIOD
        if len(rows):
            doubt = (f'nothing of {NAME} can be read; commands count as m/s for '
                     f'{CONTROL_PERIOD:g} s each')
    # What no command uses does not count: an arm's own value may replace the recorder's at once.
    used = np.append(first, told)[np.searchsorted(period.log, twist.log[rows], 'right')]
    changes = np.flatnonzero(np.diff(used))
    if len(changes):
        at, times = changes[0], f'{len(changes)} times' if len(changes) > 1 else 'once'
        doubt = (f'{NAME} changes {times}, first from {used[at]:g} to {used[at + 1]:g} s; a '
                 'command lasts for what was told last. If a second planner told it, record '
                 'without that one')
    if doubt:
        warnings.warn(f'{parts[0].source}: {doubt}', RecordingWarning, stacklevel=4)
    return used[:, None]


def last_told(parts: Sequence[Columns], before: float | None) -> float | None:
    """Return the period (s) that files of a bag tell last, else that of those before them."""
    told = [part.arrays['period_values'][-1, 0] for part in parts
            if len(part.arrays.get('period_values', ()))]
    return float(told[-1]) if told else before
