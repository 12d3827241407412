# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of growth: what times do as work grows, in episodes, objects, pixels, samples, clients.

Times are medians by the clock, so nothing else should run. Each is told beside that of the least
work, and the rate of a large matrix product says what the machine can do.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
import json
import os
from pathlib import Path
import platform
import tempfile
import time
from typing import Literal

from experiments.bench.planning import as_scene, push_until_low, time_plans
from experiments.bench.speed import matrix_rate
from experiments.bench.training import time_step
from experiments.pages import number, render
from experiments.paper.figures import new_figure, to_png
import numpy as np
import pandas as pd
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from tap_ros.engines.task import Engine
from tap_ros.files import write_atomically, write_rows
from tap_ros.options import Flag
from tap_ros.planning.mpc_config import FIRST_SCENE, with_preset, with_samples
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.training_config import TrainingConfig
from tap_ros.recording.cache import open_recordings
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL
import torch
from tqdm import tqdm

PAGE, ROWS, PICTURE = 'growth.md', 'growth.json', '../images/growth.png'
STEPS = 10  # of a training, timed
AXES = {'episodes': 'episodes', 'objects': 'objects', 'sizes': 'side of the pictures, pixels',
        'samples': 'samples of an iteration', 'clients': 'clients that ask at once'}
Part = Literal['episodes', 'objects', 'sizes', 'samples', 'clients']
Row = dict[str, str | float]


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param parts: what grows.
    :param episodes: how many are collected, decoded and opened again.
    :param objects: how many are planned for and predicted.
    :param sizes: sides of pictures, in pixels, that are drawn and trained on.
    :param samples: of a plan, with three iterations.
    :param clients: how many ask the predictor node at once.
    :param repeats: how often each time is taken; the median counts.
    :param seconds: how long the clients ask.
    :param write: also write docs/results/growth.json, growth.md and docs/images/growth.png; parts
        that are not measured stay there as they are.
    """

    parts: tuple[Part, ...] = tuple(AXES)
    episodes: tuple[int, ...] = (10, 30, 100, 300)
    objects: tuple[int, ...] = (1, 2, 3, 4, 5)
    sizes: tuple[int, ...] = (64, 128)
    samples: tuple[int, ...] = (64, 100, 200, 400, 800, 1600)
    clients: tuple[int, ...] = (1, 4, 16, 64)
    repeats: int = 15
    seconds: float = 5
    write: Flag = False


def run(args):
    """Measure part by part; print and perhaps write what was found."""
    measure = {'episodes': _episodes, 'objects': _objects, 'sizes': _sizes, 'samples': _samples,
               'clients': _clients}
    rows: list[Row] = []
    print(f'matrix product: {matrix_rate("cpu", torch.float32) / 1e9:.0f} G operations/s')
    with tqdm(total=sum(len(getattr(args, part)) for part in args.parts), unit='size') as bar:
        for part in args.parts:
            for row in measure[part](args):
                rows.append({'part': part, **row})
                bar.set_postfix_str(f'{part} {row["size"]}: {row["work"]} {row["ms"]:.1f} ms')
                bar.n = len({(row['part'], row['size']) for row in rows})
                bar.refresh()
    print(make_table(rows).to_string(index=False))
    if args.write:
        folder = Path('docs/results')
        if (folder / ROWS).exists():
            rows += [row for row in json.loads((folder / ROWS).read_text())
                     if row['part'] not in args.parts]
        rows.sort(key=lambda row: list(AXES).index(row['part']))
        write_rows(folder / ROWS, rows)
        write_atomically(folder / PAGE, make_page(rows))
        write_atomically(folder / PICTURE, draw(rows))


def make_table(rows):
    """
    Return what was measured as a DataFrame: a line for each size.

    :param rows: dicts of part, size, work and ms.
    """
    table = pd.DataFrame(rows)
    first = table.groupby(['part', 'work'])['ms'].transform('first')
    table['least'] = table['ms'] / first
    return pd.DataFrame({
        'grows': table['part'], 'to': table['size'], 'work': table['work'],
        'time': number(table['ms'], 1) + ' ms', 'ratio to the least': number(table['least'], 2)})


def make_page(rows):
    """Return the page, as Markdown."""
    return render('bench/templates/growth.md.j2', table=make_table(rows), picture=PICTURE,
                  cores_here=len(os.sched_getaffinity(0)), processor=platform.machine(),
                  python=platform.python_version())


def draw(rows):
    """Return the curves as a PNG: a panel for each part, dashed where time grows with the work."""
    table = pd.DataFrame(rows)
    parts = list(dict.fromkeys(table['part']))
    figure, axes = new_figure(3.2, len(parts))
    for axis, part in zip(axes[0], parts):
        here = table[table['part'] == part]
        for work, line in here.groupby('work', sort=False):
            sizes, ms = line['size'].to_numpy(float), line['ms'].to_numpy(float)
            axis.plot(sizes, ms, marker='o', markersize=3, linewidth=1.4, label=work)
            axis.plot(sizes, ms[0] * sizes / sizes[0], color='#b0b0b0', linewidth=0.8,
                      linestyle='--', zorder=0)
        axis.set(xscale='log', yscale='log')
        axis.set_xticks(ticks := sorted(set(here['size'])), [f'{tick:g}' for tick in ticks],
                        fontsize=6)
        axis.minorticks_off()
        axis.set_xlabel(AXES[part], fontsize=8)
        axis.legend(fontsize=6, frameon=False, loc='upper left')
    axes[0, 0].set_ylabel('ms', fontsize=8)
    return to_png(figure)


def _time(work, *args):
    """Return the ms of a call."""
    begin = time.perf_counter()
    work(*args)
    return 1e3 * (time.perf_counter() - begin)


def _median(repeats, work, *args):
    """Return the median ms of a call, after one to warm up."""
    return float(np.median([_time(work, *args) for _ in range(repeats + 1)][1:]))


def _episodes(args) -> Iterator[Row]:
    for count in args.episodes:
        with tempfile.TemporaryDirectory() as folder:
            bag = f'{folder}/bag'
            yield {'size': count, 'work': 'collect', 'ms': _time(
                collect, bag, CollectConfig(episodes=count), Engine(workers=1), False)}
            for work in ('decode into the cache', 'open again'):
                # A cache of its own: in the user's the same episodes may be from last time.
                yield {'size': count, 'work': work, 'ms': _time(
                    partial(open_recordings, progress=False), [bag], f'{folder}/cache')}


def _objects(args) -> Iterator[Row]:
    predictor = SubgoalPredictor.load(DEFAULT_PREDICTOR)
    planner = VisualMPC.load(FORWARD_MODEL, with_preset('default'))
    seen, goal = _while_pushing(planner)
    for count in args.objects:
        pixels = np.array([[12 + 8 * i, 20 + 5 * i] for i in range(count)], np.float32)
        yield {'size': count, 'work': 'plan', 'ms': _median(
            args.repeats, planner.plan, replace(as_scene(seen), object_pixels=pixels),
            planner.goal(pixels + 6))}
        yield {'size': count, 'work': 'predict', 'ms': _median(
            args.repeats, predictor.predict, seen.image, goal.image, pixels, pixels + 6)}


def _while_pushing(planner):
    """Return what is seen while the first object is pushed, and the goal; Observations."""
    simulator = Simulator('push2')
    simulator.reset(FIRST_SCENE)
    goal = simulator.goal()
    seen = push_until_low(simulator, planner, goal.object_pixels)
    simulator.close()
    return seen, goal


def _sizes(args) -> Iterator[Row]:
    for size in args.sizes:
        simulator = Simulator('push2', image_size=size)
        simulator.reset(FIRST_SCENE)
        yield {'size': size, 'work': 'draw a picture', 'ms': _median(
            args.repeats, simulator.observe)}
        simulator.close()
        with tempfile.TemporaryDirectory() as folder:
            collect(f'{folder}/bag', CollectConfig(episodes=4, image_size=size),
                    Engine(workers=1), progress=False)
            config = TrainingConfig(
                recordings=(f'{folder}/bag',), out=f'{folder}/run', method='genmin-wo-gan',
                decoder='shared', skips=True, base_width=16, batch_size=24, save_every=10 ** 9)
            yield {'size': size, 'work': 'step of training',
                   'ms': 1e3 * time_step(config, STEPS).seconds}


def _samples(args) -> Iterator[Row]:
    planner = VisualMPC.load(FORWARD_MODEL, with_preset('large'))
    seen, goal = _while_pushing(planner)
    for count in args.samples:
        more = VisualMPC(planner.model, with_samples(planner.config, count))
        yield {'size': count, 'work': 'plan', 'ms': float(np.median(
            time_plans(more, seen, goal.object_pixels, args.repeats, warm=True)))}


def _clients(args) -> Iterator[Row]:
    from experiments.bench.nodes.service import measure_load  # needs ROS
    from tap_ros.nodes.node_processes import NodeProcesses
    with tempfile.TemporaryDirectory() as folder, NodeProcesses(folder) as nodes:
        nodes.start('predictor_node')
        for count in args.clients:
            load = measure_load(count, args.seconds)
            yield {'size': count, 'work': 'wait for an answer',
                   'ms': 1e3 * float(np.median(load.latencies))}
        nodes.check()
