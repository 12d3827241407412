# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Results from finished runs: the numbers as data, a plot and a picture."""

import json
from pathlib import Path

from experiments.paper import figures
from experiments.paper.pictures import write_picture
from experiments.paper.rows import as_frame, COPIES, group_runs, make_rows
from experiments.paper.runs import label
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically


def load_runs(folder):
    """Read the files SCALE/RUN.json; methods are named as runs.label has it."""
    runs = []
    for path in sorted(Path(folder).glob('*/*.json')):
        try:
            run = json.loads(path.read_text())
        except ValueError as error:
            raise ConfigError(
                f'{path}: is damaged ({error}); remove it and run it again') from None
        run['method'] = label(run['method'], run.get('variant', ''), run.get('recursion', 1))
        runs.append(run)
    return runs


def on_same_episodes(runs):
    """
    Return the runs that were scored on the episodes of most of their kind, and the others.

    What copying an input costs in each tells them apart; the hash of a recording also depends on
    the last digits of joint positions, in which machines differ.
    """
    counts = {}
    for run in runs:
        scores, where = run['evaluation'], (run['scale'], run['task'], run['mode'])
        others = [other['copy-goal'] for _, other in sorted(scores.get('shifted', {}).items())]
        data = tuple(tuple(copied['min_l1']) for copied in (
            *(scores[copy] for copy in COPIES if copy in scores), *others))
        counts.setdefault(where, {}).setdefault(data, []).append(run)
    usual = [max(found.values(), key=len) for found in counts.values()]
    kept = [run for run in runs if any(run in same for same in usual)]
    return kept, [run for run in runs if run not in kept]


def write_results(places):
    """Write prediction.csv, the plot of timing, and a picture where weights are at hand."""
    folder = Path(places.results)
    loaded = load_runs(folder / 'runs')
    if not loaded:
        raise ConfigError(f'{folder / "runs"}: there are no finished runs; make some with '
                          'python -m experiments paper')
    kept, left_out = on_same_episodes(loaded)
    if left_out:
        print('scored on other episodes, left out: ' + ', '.join(run['name'] for run in left_out))
    rows = as_frame(make_rows(group_runs(kept)))
    write_atomically(folder / 'prediction.csv', rows.to_csv(index=False))
    png = figures.timing(rows)
    if png is not None:
        write_atomically(folder / 'timing.png', png)
    write_picture(places, kept)
    return rows
