# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of the engines: what a task costs beside its own work, and how long starting takes."""

from dataclasses import dataclass
import math
import os
from pathlib import Path
import platform
import time

from experiments.pages import number, render
import pandas as pd
from tap_ros.engines.run import run_tasks
from tap_ros.engines.task import Engine, EngineName, ENGINES, Task
from tap_ros.files import write_atomically, write_rows
from tap_ros.options import Flag

FEW, MANY = 50, 1050  # tasks that do nothing
SLEEP_S = 0.1
SLEEPS = 20  # tasks that sleep, for each worker
MACHINES, CORES, EPISODES, PER_FILE, EPISODE_S = 100, 2, 10_000, 25, 0.23


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param engines: which are measured.
    :param workers: with how many each.
    :param write: also write docs/results/engine.json and engine.md.
    """

    engines: tuple[EngineName, ...] = ENGINES
    workers: tuple[int, ...] = (1, 2, 4, 8, 16)
    write: Flag = False


def run(args):
    """Measure each engine with each number of workers; print and perhaps write what was found."""
    rows = []
    print(f'{"engine":8}{"workers":>8}{"a task":>12}{"start":>10}{"sleeping":>10}')
    for name in args.engines:
        for workers in args.workers:
            rows.append(measure(name, workers))
            row = rows[-1]
            print(f'{name:8}{workers:8}{row["task_ms"]:9.2f} ms{row["start_s"]:8.1f} s'
                  f'{row["sleeping"]:10.2f}', flush=True)
    if args.write:
        write_rows(Path('docs/results/engine.json'), rows)
        write_atomically(Path('docs/results/engine.md'), make_page(rows))


def measure(name, workers):
    """
    Measure one engine.

    :return: dict of engine, workers, task_ms (a task that does nothing), start_s (until the first
        has ended), and sleeping: the time of tasks that sleep, divided by the ideal.
    """
    few, start = _time(name, workers, [Task(str(i), _nothing) for i in range(FEW)])
    many, _ = _time(name, workers, [Task(str(i), _nothing) for i in range(MANY)])
    tasks = [Task(str(i), time.sleep, (SLEEP_S,)) for i in range(SLEEPS * workers)]
    # From the end of the first on, when all workers are there.
    asleep, _ = _time(name, workers, [Task(str(i), _nothing) for i in range(FEW)] + tasks)
    return {'engine': name, 'workers': workers,
            'task_ms': round(1e3 * (many - few) / (MANY - FEW), 3), 'start_s': round(start, 2),
            'sleeping': round(asleep / (SLEEPS * SLEEP_S), 3)}


def _time(name, workers, tasks):
    """Return the seconds from the first end to the last, and those until the first."""
    begin, first = time.perf_counter(), None
    for _, get in run_tasks(tasks, Engine(name, workers)):
        get()
        first = first or time.perf_counter()
    return time.perf_counter() - first, first - begin


def _nothing():
    pass


def make_page(rows):
    """Return the page, as Markdown, from the rows of measure."""
    rows = pd.DataFrame(rows)
    table = pd.DataFrame({
        'engine': rows['engine'], 'workers': rows['workers'],
        'a task that does nothing': number(rows['task_ms'], 2) + ' ms',
        'start to the first end': number(rows['start_s'], 1) + ' s',
        'sleeping tasks': number(rows['sleeping'], 2)})
    last, files, workers = rows.iloc[-1], EPISODES // PER_FILE, MACHINES * CORES
    rounds, task_s = math.ceil(files / workers), PER_FILE * EPISODE_S
    return render(
        'bench/templates/engine.md.j2', table=table, sleep=SLEEP_S, episodes=EPISODES,
        cores_here=len(os.sched_getaffinity(0)), processor=platform.machine(),
        python=platform.python_version(), machines=MACHINES, cores=CORES, files=files,
        per_file=PER_FILE, task_s=task_s, episode_s=EPISODE_S, workers=workers, rounds=rounds,
        work_s=rounds * task_s, start_s=last['start_s'], hand_s=files * last['task_ms'] / 1e3)
