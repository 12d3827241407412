# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmark of starting: from a command until all nodes of `make explore` are ready."""

from dataclasses import dataclass
import os
import tempfile
import time

from experiments.bench.rows import Row
from tap_ros.apps.explorer import command
from tap_ros.apps.node_processes import NodeProcesses

AIM_S = 10
NODES = ('sim_node', 'tracker_node', 'predictor_node', 'visual_mpc_node', 'explorer_node')


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param starts: the best of so many counts.
    """

    starts: int = 3


def run(args):
    """Start all nodes, say when they were ready and what CPU time each took."""
    found = [time_start() for _ in range(args.starts)]
    seconds, spent = min(found, key=lambda one: one[0])
    total = sum(spent.values())
    yield Row(
        'start of all nodes of `make explore`', f'{seconds:.1f} s',
        seconds / total * len(os.sched_getaffinity(0)), f'the CPU time, {total:.1f} s, on all '
        'cores', f'at most {AIM_S} s', seconds <= AIM_S, 'CPU time: ' + ', '.join(
            f'{name} {each:.1f} s' for name, each in spent.items()))


def time_start():
    """Start all nodes; return after how many s they were ready, and the CPU time of each, s."""
    with tempfile.TemporaryDirectory() as folder, NodeProcesses(folder) as processes:
        begin = time.perf_counter()
        command.start_nodes(processes, command.Options(port=0))
        processes.wait_until_ready()
        return time.perf_counter() - begin, {name: processes.cpu_s(name) for name in NODES}
