# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of collecting: seconds per recorded episode, split into its parts."""

from dataclasses import dataclass
import os
from pathlib import Path
import tempfile
import time
from typing import Annotated

from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import task_names
from tap_ros.engines import Engine
from tap_ros.options import one_of


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param task: what is recorded.
    :param episodes: how many to collect.
    :param workers: processes; 0: one a core.
    """

    task: Annotated[str, one_of(task_names())] = 'push2'
    episodes: int = 60
    workers: int = 0


def run(args):
    """Collect into a temporary folder and print where the time went."""
    with tempfile.TemporaryDirectory() as folder:
        config = CollectConfig(task=args.task, episodes=args.episodes, episodes_per_file=5)
        result = collect(Path(folder) / 'bench', config, Engine(workers=args.workers))
        size = sum(path.stat().st_size for path in Path(folder).rglob('*.mcap'))
    simulator = Simulator(args.task)
    simulator.reset(0)
    begin = time.perf_counter()
    for _ in range(200):
        simulator.observe()
    render = (time.perf_counter() - begin) / 200 * result['frames']
    seconds, episodes = result['seconds'], result['episodes']
    physics = seconds['act'] - render
    busy = seconds['act'] + seconds['write']
    workers = args.workers or len(os.sched_getaffinity(0))
    print(f"""task {args.task}, seed 0, {episodes} episodes of {result['frames'] / episodes:.1f} \
frames on average, {workers} workers
seconds per episode (wall, workers side by side)  {seconds['wall'] / episodes:.2f}
  scaled to 40 frames                             \
{40 * seconds['wall'] / result['frames']:.2f}
share of the workers' time: physics               {physics / busy:.0%}
                            rendering             {render / busy:.0%}
                            writing               {seconds['write'] / busy:.0%}
mean final distance                               {100 * result['mean_final_distance']:.1f} cm
success rate (all objects within 5 cm)            {result['success_rate']:.0%}
size of the recording per frame                   {size / result['frames'] / 1024:.1f} KiB""")
