# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs what `python -m experiments planning` asks for, and writes its results."""

from pathlib import Path
import shlex

from experiments.planning.films import write_film
from experiments.planning.methods import FIRST_SCENES, parse_method, STACKING_TASKS, USUAL
from experiments.planning.results import make_rows, make_stack_rows
from experiments.planning.runs import Job, load_results, run_jobs
from sim_bridge.world.looks import DEFAULT_LOOK
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_rows
from tap_ros.planning.mpc_config import with_preset
from tap_ros.weights import find_predictor, FORWARD_MODEL

# What the command paper calls the predictors that methods stand for.
_NAMES = {'fix': 'fix-wo-gan+skips', 'genmin': 'genmin-wo-gan+skips',
          'genmin+progress': 'genmin-wo-gan+progress+skips',
          'genmin+relative': 'genmin-wo-gan+relative+skips'}
RUNS = {base + suffix: name + text for base, name in _NAMES.items() for suffix, text in (
    ('', ''), ('+rounds', '+rounds'), ('-r2', '-r2'))}
TRAINED = 'runs/paper/small/{task}-bidirectional-{name}{warp}-s0/predictor.safetensors'
# Options that change numbers, for the command that makes them again, with what is usual.
TOLD = (('look', DEFAULT_LOOK), ('seed', 0), ('preset', 'default'), ('solver', 'cem'),
        ('forward_weights', str(FORWARD_MODEL)), ('device', 'cpu'))


def evaluate(args):
    """Run what is missing; write the numbers and the films."""
    if args.scenes < 1:
        raise ConfigError('scenes must be at least 1')
    out = Path(args.out)
    if not args.results_only:
        for first, jobs in make_jobs(args).items():
            files = run_jobs(jobs, range(first, first + args.scenes), out, args.engine)
            write_results(out)  # first: whatever happens to the films, these stay
            for job, file in zip(jobs, files):
                if not args.no_films and job.method.base != 'nothing':
                    write_film(job, file.scenes, out / f'{job.file_name}.png')
    for row in write_results(out):
        if row['metric'] in ('success', 'success_5cm', 'final_distance_cm'):
            print(f'  {row["task"]:10} {row["method"]:29} {row["metric"]:17} {row["value"]:6.2f} '
                  f'[{row["ci_low"]:.2f}, {row["ci_high"]:.2f}], {row["n"]} scenes')


def write_results(out):
    """Write planning.json and stacking.json from the scenes that were run; return the rows."""
    rows = []
    for name, make in (('planning', make_rows), ('stacking', make_stack_rows)):
        if found := make(load_results(out / name)):
            write_rows(out / f'{name}.json', found)
            rows += found
    if not rows:
        raise ConfigError(f'{out}: planning/ and stacking/ hold no results; run without '
                          '--results-only')
    return rows


def make_jobs(args):
    """Return the Jobs of tasks and methods by first seed; usual ones only where weights are."""
    planner = with_preset(args.preset, solver=args.solver)
    named, jobs = {'shipped': '{task}'}, {}
    for text in args.predictor:
        name, found, named[name] = text.partition('=')
        if not found:
            raise ConfigError(f'--predictor {text}: expected NAME=FILE')
    for task in args.tasks:
        stacks = task in STACKING_TASKS
        for method in dict.fromkeys(map(parse_method, args.methods or USUAL[task])):
            file = ''
            if method.predicted:
                try:
                    file = find_weights(method, task, named)
                except ConfigError as error:
                    if args.methods or not stacks:
                        raise
                    print(f'  {task}: left out: {error}')
                    continue
            jobs.setdefault(args.seed or FIRST_SCENES[task], []).append(Job(
                task, method, planner, args.forward_weights, file, args.device, args.preset,
                _command(args, task, method), args.look))
    return jobs


def find_weights(method, task, named):
    """Return the weights of a method that predicts, by names with {task}; ConfigError without."""
    name, warp = RUNS.get(method.base, method.base), '' if task in STACKING_TASKS else '-warp'
    usual = TRAINED.format(task=task, name=name, warp=warp)
    file = str(find_predictor(named.get(method.base, usual).replace('{task}', task)))
    if not Path(file).is_file():
        raise ConfigError(
            f'method {method.name!r}: no weights {file}; train them with `python -m experiments '
            f'paper --only "{Path(usual).parent.name}"`, name them with --predictor '
            f'{method.base}=FILE, or leave the method out with --methods')
    return file


def _command(args, task, method):
    """Return the command that makes the numbers of one method again."""
    words = ['python -m experiments planning --tasks', task, '--methods', method.name,
             '--scenes', str(args.scenes)]
    for option, usual in TOLD:
        value = getattr(args, option)
        if value != usual:
            words += ['--' + option.replace('_', '-'), shlex.quote(str(value))]
    words += [word for text in args.predictor if text.split('=')[0] == method.base
              for word in ('--predictor', shlex.quote(text))]
    return ' '.join(words)
