# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of collecting: seconds per recorded episode, split into its parts."""

from dataclasses import dataclass
from pathlib import Path
import tempfile
import time
from typing import Annotated

from experiments.bench.rows import Row
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import task_names
from tap_ros.base.engines import Engine
from tap_ros.base.options import one_of


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
    """Collect into a temporary folder and say where the time went."""
    with tempfile.TemporaryDirectory() as folder:
        config = CollectConfig(task=args.task, episodes=args.episodes, episodes_per_file=5)
        result = collect(Path(folder) / 'bench', config, Engine(workers=args.workers))
    simulator = Simulator(args.task, 64)
    simulator.reset(0)
    begin = time.perf_counter()
    for _ in range(200):
        simulator.observe()
    render = (time.perf_counter() - begin) / 200 * result['frames']
    seconds = result['seconds']
    busy = seconds['act'] + seconds['write']
    yield Row(
        f'collect an episode of `{args.task}`', f'{seconds["wall"] / result["episodes"]:.2f} s',
        busy / (seconds['act'] - render), 'its physics, in CPU time',
        limit=f'rendering {render / busy:.0%}, writing {seconds["write"] / busy:.0%}')
