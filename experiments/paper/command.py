# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros paper`: make the paper's prediction results again."""

from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import chain
from typing import Annotated

from experiments.paper.places import Places
from experiments.paper.runs import paper_runs, SCALES
from experiments.paper.sweep import data_hashes, find_state, sweep
import numpy as np
from tap_ros.engines import Engine
from tap_ros.errors import ConfigError
from tap_ros.options import default_text, Flag, Folder, one_of
from tyro import conf


@dataclass(frozen=True)
class PlaceOptions(Places):
    """Where things are."""

    recordings: Folder = Places.recordings
    runs: Folder = Places.runs
    results: Folder = Places.results


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param scale: small: for two CPU cores; full: as in the paper, for a large GPU.
    :param only: only runs whose names fit, such as "grasp-forward-*".
    :param list: show the runs, how far they are and their scores; do nothing.
    :param collect: make the recordings only.
    :param results_only: only write the data and figures of the runs that are done.
    :param limit: stop after so many; the next call goes on.
    :param seeds: of the trainings; none: 0, and 0 1 2 of the main rows.
    :param episodes: collect so many of each task; 0: as the scale says.
    :param steps: train for so many steps; 0: as the scale says.
    :param fresh: begin runs anew that were begun with other settings or recordings.
    """

    scale: Annotated[str, one_of(SCALES)] = 'small'
    only: Annotated[conf.UseAppendAction[tuple[tuple[str, ...], ...]], conf.arg(
        metavar='PATTERN [PATTERN ...]', help_behavior_hint='(default: all)')] = ()
    list: Flag = False
    collect: Flag = False
    results_only: Flag = False
    limit: Annotated[float | None, conf.arg(
        aliases=('--slice-minutes',), metavar='MINUTES', help_behavior_hint=default_text)] = None
    seeds: tuple[int, ...] = ()
    episodes: int = 0
    steps: int = 0
    fresh: Flag = False
    engine: Engine = Engine()
    places: PlaceOptions = PlaceOptions()


def run(args):
    """
    Do what the command line says.

    :param args: Options.
    :return: exit status: 0, or 1 if a run failed.
    :raises ConfigError: if no run fits, or a number makes no sense.
    """
    if min(args.episodes, args.steps) < 0 or (args.limit or 1) <= 0:
        raise ConfigError('limit, episodes, steps: expected numbers above 0')
    places = args.places
    if args.results_only:
        _write_results(places, pictures=True)
        return 0
    runs = choose_runs(args)
    if args.list:
        show(runs, places)
        return 0
    ends = sweep(runs, places, args.engine, args.limit, args.fresh, args.collect,
                 on_done=lambda: _try_results(places, pictures=False))
    failed = [end for end in ends if end.kind == 'failed']
    if not args.collect:
        _try_results(places, pictures=True)
    hashes = data_hashes(runs, places)
    states = [find_state(run, places, hashes) for run in runs]
    print(f"{sum(state.kind == 'done' for state in states)} of {len(runs)} runs are done")
    elsewhere = [run for run in runs if run.task not in hashes]
    if elsewhere and not ends:
        print(f'{len(elsewhere)} of them elsewhere: their scores are in {places.results}, their '
              'recordings are not here. To make them again beside these: '
              "make paper ARGS='--runs runs/again --results runs/again/results'")
    for end in ends:
        if end.kind == 'busy':
            print(f'{end.name}: another sweep is at it')
    for end in failed:
        print(f'{end.name} failed: {end.reason} (see {end.place})')
    if failed and any(state.kind == 'other' for state in states):
        print('--fresh begins runs anew that were begun with other settings or recordings')
    return 1 if failed else 0


def choose_runs(args):
    """
    List the runs that are asked for.

    :raises ConfigError: if a pattern fits none; the message names it.
    """
    runs = paper_runs(args.scale, args.seeds, args.episodes, args.steps)
    patterns = list(chain(*args.only))
    if not patterns:
        return runs
    for pattern in patterns:
        if not any(fnmatch(run.name, pattern) for run in runs):
            raise ConfigError(f'--only {pattern}: no run has such a name; --list shows all')
    return [run for run in runs if any(fnmatch(run.name, pattern) for pattern in patterns)]


def show(runs, places):
    """Print a line for each run: its state and scores."""
    hashes = data_hashes(runs, places)
    width = max(len(run.name) for run in runs)
    print(f'{"run":{width}s}{"state":>16s}{"min l1":>9s}{"match (share)":>15s}{"2 px":>8s}')
    for run in runs:
        state = find_state(run, places, hashes)
        text = {'partial': f'{state.steps}/{run.num_steps} steps',
                'other': 'other settings'}.get(state.kind, state.kind)
        print(f'{run.name:{width}s}{text:>16s}{_scores(state.result)}')


def _scores(result):
    """Write the scores of a run that is done: error, match, share of bottlenecks."""
    if result is None:
        return ''
    scores = result['evaluation']['prediction']
    placed = [x for x in scores['bottleneck'] if x is not None]
    text = f'{np.mean(scores["min_l1"]):9.4f}{np.mean(scores["match_fraction"]):15.2f}'
    return text + (f'{np.mean(np.array(placed) <= 2):8.0%}' if placed else '')


def _write_results(places, pictures):
    """Write the data and figures."""
    from experiments.paper.results import write_results
    write_results(places.results, runs=places.runs, recordings=places.recordings,
                  pictures=pictures)


def _try_results(places, pictures):
    """Write the data and figures, but let the runs go on if that fails."""
    try:
        _write_results(places, pictures)
    except Exception as error:
        print(f'{places.results}: the results could not be written: {error!r}; try again with '
              '--results-only')
