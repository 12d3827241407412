# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The same work alone and beside processes that spin, one a core, in turns.

Beside N processes that spin on c cores, each of t threads that work gets c / (t + N) of a core.
So work that keeps t cores busy when alone takes (t + N) / c times as long; what is more is lost.
"""

from collections.abc import Callable
import contextlib
from dataclasses import dataclass
from functools import partial
import os
from pathlib import Path
import tempfile
import time

from experiments.bench import planning, recording, training
from experiments.bench.nodes import service, start
from experiments.bench.rows import Row
from experiments.planning.methods import FIRST_SCENE
import numpy as np
from sim_bridge.simulator import Simulator
from tap_ros.apps.node_processes import NodeProcesses
from tap_ros.planning.mpc_config import with_preset
from tap_ros.planning.visual_mpc import VisualMPC
from tap_ros.ros.calls import call
from tap_ros.ros.client import Client
from tap_ros.ros.topics import SERVICE_QOS
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights import DEFAULT_PREDICTOR, FORWARD_MODEL

CORES = len(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param pairs: how often each work is done alone and beside the others.
    :param spinning: processes that spin; 0: one a core.
    """

    pairs: int = 3
    spinning: int = 0


@dataclass(frozen=True)
class Work:
    """Something that takes time."""

    what: str
    threads: int  # that can work at once
    seconds: Callable[[], float]  # does it, and returns how long a unit of it took


def run(args):
    """Measure how much longer each work takes beside others."""
    with contextlib.ExitStack() as stack:
        for work in works(stack):
            work.seconds()  # to warm up
            yield compare(work, args.pairs, args.spinning or CORES)


def compare(work, pairs, count):
    """Do a work in turns alone and beside `count` processes; return the row."""
    times = np.empty((pairs, 2))
    for pair in times:
        pair[0] = work.seconds()
        with recording.beside(count):
            pair[1] = work.seconds()
    ratios, share = times[:, 1] / times[:, 0], (work.threads + count) / CORES
    reached = bool(np.median(ratios) <= share)
    return Row(f'{work.what} beside {count} busy processes',
               f'{1000 * np.median(times[:, 1]):,.1f} ms', float(np.median(ratios)),
               f'alone ({ratios.min():.2f} to {ratios.max():.2f})',
               f'at most {share:.1f}', reached,
               '' if reached else 'waiting for a core')


def works(stack):
    """Yield every Work; what it needs ends with the stack."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    paths, _ = recording.write_files(folder, 'none', 100, 1)
    yield Work('open 100 episodes', 1, partial(open_files, paths))
    yield Work('training step', 1, train_steps)
    simulator = Simulator('push2', 64)
    seen, goal = simulator.reset(FIRST_SCENE), simulator.goal().object_pixels
    simulator.close()
    mpc = VisualMPC.load(FORWARD_MODEL, with_preset('large'))
    yield Work('plan of `large`', CORES,
               lambda: np.median(planning.time_plans(mpc, seen, goal, 5)[0]) / 1000)
    with predictor(folder):
        with asking() as seconds:
            yield Work('answer', 1, seconds)
        yield Work('answer to one of 16 clients', CORES,
                   lambda: 1 / service.measure_load(16, 3).per_second)
    with contextlib.suppress(PermissionError), recording.scheduled(os.SCHED_RR, 1), \
            predictor(folder), asking() as seconds:
        yield Work('answer, node and client by `chrt --rr 1`,', 1, seconds)
    yield Work('start of all nodes', CORES, lambda: start.time_start()[0])


@contextlib.contextmanager
def predictor(folder):
    """Run a predictor node."""
    with NodeProcesses(folder) as nodes:
        nodes.start('predictor_node', weights=DEFAULT_PREDICTOR)
        nodes.wait_until_ready()
        yield


@contextlib.contextmanager
def asking():
    """Give a function that asks a predictor node a hundred times, and returns the s of a call."""
    with Client() as client:
        ask, request = service.make_client(client, SERVICE_QOS.depth), service.make_request()
        yield lambda: np.median(service.timed(
            partial(call, ask, request, service.TIMEOUT), 100))


def open_files(paths):
    """Open files for the first time; return s."""
    with tempfile.TemporaryDirectory() as scratch:
        begin = time.perf_counter()
        recording.build_cache(paths, scratch)
        return time.perf_counter() - begin


def train_steps():
    """Train as the last row of the ladder does; return s a step."""
    with tempfile.TemporaryDirectory() as folder:
        return training.time_step(TrainingConfig(
            recordings=training.Options.recordings, out=folder, save_every=10 ** 9,
            **training.LADDER[-1]), 10).seconds
