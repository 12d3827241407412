# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m experiments paper`: make the paper's prediction results again."""

from dataclasses import dataclass
from fnmatch import fnmatch
from typing import Annotated

from experiments.paper.runs import paper_runs
from experiments.paper.sweep import find_result, Places, sweep
import numpy as np
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError
from tap_ros.base.options import Flag
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param only: only runs whose names fit, such as "grasp-forward-*".
    :param list: show which runs are done, and their scores; do nothing.
    :param results_only: only write the data and figures of the runs that are done.
    """

    only: Annotated[tuple[str, ...], conf.arg(
        metavar='PATTERN [PATTERN ...]', help_behavior_hint='(default: all)')] = ()
    list: Flag = False
    results_only: Flag = False
    engine: Engine = Engine()
    places: Places = Places()


def run(args):
    """Do what the command line says; return 1 if a run failed. ConfigError if no run fits."""
    runs, failed = [run for run in paper_runs() if not args.only or any(
        fnmatch(run.name, pattern) for pattern in args.only)], {}
    if not runs:
        raise ConfigError(f'--only {" ".join(args.only)}: no run has such a name; --list shows '
                          'all')
    if args.list:
        show(runs, args.places)
        return 0
    if not args.results_only:
        failed = sweep(runs, args.places, args.engine)
    from experiments.paper.results import write_results
    write_results(args.places)
    print(f'{len(runs) - len(failed)} of {len(runs)} runs are done')
    return 1 if failed else 0


def show(runs, places):
    """Print a line for each run: whether it is done, error, match, share of bottlenecks."""
    width = max(len(run.name) for run in runs)
    print(f'{"run":{width}s}{"min l1":>9s}{"match (share)":>15s}{"2 px":>8s}')
    for run in runs:
        result, text = find_result(run, places), '  not done'
        if result is not None:
            scores = result['evaluation']['prediction']
            placed = np.array([x for x in scores['bottleneck'] if x is not None])
            text = f'{np.mean(scores["min_l1"]):9.4f}{np.mean(scores["match_fraction"]):15.2f}'
            text += f'{np.mean(placed <= 2):8.0%}' if len(placed) else ''
        print(f'{run.name:{width}s}{text}')
