# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs what `python -m tap_ros evaluate stacking` asks for, and writes its results."""

from pathlib import Path
import shlex

from experiments.planning.evaluate import find_weights, named_weights
from experiments.planning.results import load_results
from experiments.planning.runs import run_jobs
from experiments.stacking.command import DEFAULT_METHODS, FIRST_SCENE, RUNS, TRAINED
from experiments.stacking.films import write_films
from experiments.stacking.methods import parse_method
from experiments.stacking.page import make_page
from experiments.stacking.results import make_rows
from experiments.stacking.runs import Job, run_scene
from sim_bridge.world.looks import DEFAULT_LOOK
from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically, write_rows

NOT_SHOWN = ('nothing', 'lowest_first', 'oracle_order', 'true_places')  # in pictures


def evaluate(args):
    """Run what is missing; write the numbers, the page and the pictures."""
    if args.scenes < 1:
        raise ConfigError('scenes must be at least 1')
    out = Path(args.out)
    if not args.results_only:
        jobs = make_jobs(args)
        files = run_jobs(jobs, range(args.seed, args.seed + args.scenes), out / 'stacking',
                         args.engine, run=run_scene)
        _write_results(out)  # first: whatever happens to the pictures, these stay
        for job, file in zip(jobs, files):
            failed = not all(scene['success'] for scene in file.scenes.values())
            if not args.no_films and job.method.base not in NOT_SHOWN and (
                    failed or job.method.predicted):
                write_films(job, file.scenes, out / _picture(job.task, job.method))
    for row in _write_results(out):
        if row['metric'] == 'success':
            print(f'  {row["task"]} {row["method"]:29} {row["value"]:4.0%} '
                  f'[{row["ci_low"]:.0%}, {row["ci_high"]:.0%}], {row["n"]} scenes')
    print(f'written: {out / "stacking.json"}, {out / "stacking.md"}')


def _write_results(out):
    """Write stacking.json and stacking.md from the scenes that were run; return the rows."""
    results = load_results(out / 'stacking')
    if not results:
        raise ConfigError(f'{out / "stacking"}: holds no results; run without --results-only')
    rows, findings = make_rows(results), out / 'stacking_findings.md'
    write_rows(out / 'stacking.json', rows)
    write_atomically(out / 'stacking.md', make_page(
        rows, find_films(out, results), findings.read_text() if findings.exists() else ''))
    return rows


def find_films(out, results):
    """Return the pictures that are there: {(task, method): file name in out}."""
    names = {key: _picture(key[0], parse_method(key[1])) for key in results}
    return {key: name for key, name in names.items() if (out / name).exists()}


def _picture(task, method):
    return f'stacking/{task}-{method.file_name}.png'


def make_jobs(args):
    """
    Return a Job for each task and method.

    :raises ConfigError: for a method or predictor that cannot be used. The usual methods are left
        out where there are no weights of them.
    """
    named, jobs = named_weights(args.predictor), []
    for task in args.tasks:
        for method in dict.fromkeys(map(parse_method, args.methods)):
            file = ''
            if method.predicted:
                try:
                    file = find_weights(method, task, named, RUNS, TRAINED)
                except ConfigError as error:
                    if args.methods != DEFAULT_METHODS:
                        raise
                    print(f'  {task}: left out: {error}')
                    continue
            jobs.append(Job(task, method, file, args.device, args.look,
                            _command(args, task, method)))
    return jobs


def _command(args, task, method):
    """Return the command that makes the numbers of one method again."""
    words = ['python -m tap_ros evaluate stacking --tasks', task, '--methods', method.name,
             '--scenes', str(args.scenes)]
    for option, usual in (('look', DEFAULT_LOOK), ('seed', FIRST_SCENE), ('device', 'cpu')):
        if (value := getattr(args, option)) != usual:
            words += [f'--{option}', shlex.quote(str(value))]
    words += [word for text in args.predictor if text.split('=')[0] == method.base
              for word in ('--predictor', shlex.quote(text))]
    return ' '.join(words)
