# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs what `python -m tap_ros evaluate planning` asks for, and writes its results."""

from dataclasses import replace
import json
from pathlib import Path
import shlex

from experiments.planning.command import RUNS, TRAINED
from experiments.planning.films import read_caption, write_films
from experiments.planning.methods import parse_method, with_samples
from experiments.planning.page import make_page
from experiments.planning.results import load_results, make_rows
from experiments.planning.runs import Job, run_jobs
from sim_bridge.world.looks import DEFAULT_LOOK
from tap_ros.errors import ConfigError
from tap_ros.evaluation import forward
from tap_ros.files import write_atomically, write_rows
from tap_ros.planning.mpc_config import with_preset
from tap_ros.planning.scenes import FIRST_SCENE
from tap_ros.weights import find_predictor, FORWARD_MODEL


def evaluate(args):
    """Run what is missing; write the numbers, the page and the films."""
    if args.scenes < 1:
        raise ConfigError('scenes must be at least 1')
    out = Path(args.out)
    if not args.results_only:
        jobs = make_jobs(args)
        seeds = range(args.seed, args.seed + args.scenes)
        files = run_jobs(jobs, seeds, out / 'planning', args.engine)
        _write_results(out)  # first: whatever happens to the films, these stay
        for job, file in zip(jobs, files):
            name = f'{job.task}-{job.method.file_name}'
            if not args.no_films and job.method.base != 'nothing':
                write_films(job, file.scenes, out / 'planning' / f'{name}.png',
                            Path(args.recordings) / f'{name}.mcap')
    rows = _write_results(out)
    for row in rows:
        if row['metric'] == 'final_distance_cm':
            print(f'  {row["task"]} {row["method"]:24} {row["value"]:5.1f} cm '
                  f'[{row["ci_low"]:.1f}, {row["ci_high"]:.1f}], {row["n"]} scenes')
    print(f'written: {out / "planning.json"}, {out / "planning.md"}')


def _write_results(out):
    """Write planning.json and planning.md from the scenes that were run; return the rows."""
    rows = make_rows(load_results(out / 'planning'))
    if not rows:
        raise ConfigError(f'{out / "planning"}: holds no results; run without --results-only')
    write_rows(out / 'planning.json', rows)
    maps, findings = out / forward.FILE, out / 'planning_findings.md'
    write_atomically(out / 'planning.md', make_page(
        rows, find_films(out, rows),
        json.loads(maps.read_text()) if maps.exists() else (),
        findings.read_text() if findings.exists() else ''))
    return rows


def make_jobs(args):
    """
    Return a Job for each task and method.

    :raises ConfigError: for a method or predictor that cannot be used.
    """
    planner = with_preset(args.preset)
    if args.plan_samples or args.plan_iterations or args.replan_every:
        planner = changed(planner, args.plan_samples, args.plan_iterations, args.replan_every)
    named = named_weights(args.predictor)
    defaults = {'switch': args.switch, 'recursion': args.recursion, 'samples': args.samples,
                'tracking': args.tracking, 'step_budget': args.step_budget}
    methods = list(dict.fromkeys(parse_method(text, **defaults) for text in args.methods))
    jobs = []
    for task in args.tasks:
        for method in methods:
            file = ''
            if method.predicted:
                file = find_weights(method, task, named, RUNS, TRAINED)
            jobs.append(Job(task, method, planner, args.forward_weights, file, args.device,
                            args.preset, _command(args, task, method), args.look))
    return jobs


def named_weights(texts):
    """
    Read --predictor.

    :param texts: NAME=FILE each.
    :return: dict from names, also 'shipped', to files, with {task} for the task.
    :raises ConfigError: for what is none.
    """
    weights = {'shipped': '{task}'}
    for text in texts:
        name, found, file = text.partition('=')
        if not found:
            raise ConfigError(f'--predictor {text}: expected NAME=FILE')
        weights[name] = file
    return weights


def find_weights(method, task, named, runs, trained):
    """
    Find the weights of a method that predicts.

    :param method: with a base and a name.
    :param task: name.
    :param named: of named_weights.
    :param runs: what the command paper calls predictors that have a shorter name here.
    :param trained: where it leaves them, with {task} and {name}.
    :return: str, a file that is there.
    :raises ConfigError: where there is none.
    """
    usual = trained.replace('{name}', runs.get(method.base, method.base))
    file = str(find_predictor(named.get(method.base, usual).replace('{task}', task)))
    if not Path(file).is_file():
        raise ConfigError(
            f'method {method.name!r}: no weights {file}; train them with `python -m tap_ros paper '
            f'--only "{Path(usual.replace("{task}", task)).parent.name}"`, name them with '
            f'--predictor {method.base}=FILE, or leave the method out with --methods')
    return file


def changed(planner, samples, iterations, replan_every):
    """Return a VisualMPCConfig with what is not 0 changed; see methods.with_samples."""
    if samples:
        planner = with_samples(planner, samples)
    search = replace(planner.search, num_iterations=iterations or planner.search.num_iterations)
    return replace(planner, search=search, replan_every=replan_every or planner.replan_every)


def find_films(out, rows):
    """Return the film strips that are there: {(task, method): (file name in out, caption)}."""
    keys = dict.fromkeys((row['task'], row['method']) for row in rows)
    names = {key: f'planning/{key[0]}-{parse_method(key[1]).file_name}.png' for key in keys}
    return {key: (name, read_caption(out / name)) for key, name in names.items()
            if (out / name).exists()}


def _command(args, task, method):
    """Return the command that makes the numbers of one method again."""
    words = ['python -m tap_ros evaluate planning --tasks', task, '--methods', method.name,
             '--scenes', str(args.scenes)]
    for option, usual in (('look', DEFAULT_LOOK), ('seed', FIRST_SCENE), ('preset', 'default'),
                          ('plan_samples', 0), ('plan_iterations', 0), ('replan_every', 0),
                          ('forward_weights', str(FORWARD_MODEL)), ('device', 'cpu')):
        value = getattr(args, option)
        if value != usual:
            words += ['--' + option.replace('_', '-'), shlex.quote(str(value))]
    words += [word for text in args.predictor if text.split('=')[0] == method.base
              for word in ('--predictor', shlex.quote(text))]
    return ' '.join(words)
