# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of the engines: what a task costs beside its own work, and how long starting takes."""

from dataclasses import dataclass
import math
import os
from pathlib import Path
import platform
import time

from tap_ros.engine import Engine, EngineName, ENGINES, run_tasks, Task
from tap_ros.files import write_atomically, write_rows
from tap_ros.options import Flag

FEW, MANY = 50, 1050  # tasks that do nothing
SLEEP_S = 0.1
SLEEPS = 20  # tasks that sleep, for each worker
MACHINES, CORES, EPISODES, PER_FILE, EPISODE_S = 100, 2, 10_000, 25, 0.23
PAGE = """# Engines

`python -m tap_ros bench engine --write`; {machine}. Rows with more workers than cores say what the
engine itself costs; real work would share the cores.

| engine | workers | a task that does nothing | start to the first end | sleeping tasks |
|---|---|---|---|---|
{rows}

Sleeping tasks of {sleep:g} s: their time divided by the ideal, from the first end on. With Ray the
start of the other workers is in it.

**What that means for {episodes} episodes on {machines} machines of {cores} cores.** `collect` has
{files} tasks of {per_file} episodes, about {task_s:.1f} s each ({episode_s:g} s an episode, from
`bench collect`), so each of {workers} workers has {rounds} at most. With the figures of the last
row the work takes {work_s:.0f} s, starting {start_s:.0f} s and handing out all tasks
{hand_s:.1f} s: about {share:.0%} of the time is work. This is a calculation; nobody has run it.
"""


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
    """Return the page, as Markdown."""
    table = '\n'.join(
        f'| {row["engine"]} | {row["workers"]} | {row["task_ms"]:.2f} ms | {row["start_s"]:.1f} s '
        f'| {row["sleeping"]:.2f} |' for row in rows)
    files, workers = EPISODES // PER_FILE, MACHINES * CORES
    rounds, task_s = math.ceil(files / workers), PER_FILE * EPISODE_S
    hand_s = files * rows[-1]['task_ms'] / 1e3
    work_s = rounds * task_s
    return PAGE.format(
        machine=f'{len(os.sched_getaffinity(0))} cores ({platform.machine()}), Python '
        f'{platform.python_version()}', rows=table, sleep=SLEEP_S, episodes=EPISODES,
        machines=MACHINES, cores=CORES, files=files, per_file=PER_FILE, task_s=task_s,
        episode_s=EPISODE_S, workers=workers, rounds=rounds, work_s=work_s,
        start_s=rows[-1]['start_s'], hand_s=hand_s,
        share=work_s / (work_s + rows[-1]['start_s'] + hand_s))
