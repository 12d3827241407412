# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What recordings of many episodes, and of large pictures, cost: to inspect them and to train.

Each part is a command in a process of its own, which fails where it asks for more memory than the
limit (RLIMIT_DATA: all that is private and can be written), for a recording larger than that. Its
memory is the most that it and its children hold at once beside mapped files, which the system
takes back.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
import os
from pathlib import Path
import re
import resource
import subprocess
import sys
import tempfile
import time

from experiments.bench.recording import make_episode
from experiments.bench.rows import Row
from tap_ros.base.engines import run_tasks, Work
from tap_ros.recording.writer import EpisodeWriter, write_metadata

PERIOD_S = 0.05  # between two looks at a process
FILES = 4  # of a recording


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param episodes: of pictures of 64 pixels a side.
    :param large: episodes of pictures of 256 pixels a side.
    :param frames: of each episode.
    :param steps: of the trainings.
    :param limit: bytes that a process may have beside mapped files.
    :param folder: where recordings and cache are written; by default a temporary one.
    """

    episodes: int = 10_000
    large: int = 800
    frames: int = 12
    steps: int = 10
    limit: int = 1_700_000_000
    folder: str = ''


def run(args):
    """Write each recording, measure what is done with it, remove it."""
    for count, side, batch in ((args.episodes, 64, 24), (args.large, 256, 2)):
        with tempfile.TemporaryDirectory(dir=args.folder or None) as folder:
            bag = Path(folder, 'bag')
            written = write(bag, count, side, args.frames)
            inspect, train = ['inspect', str(bag)], [
                'train', 'predictor', str(bag), '--steps', str(args.steps), '--batch-size',
                str(batch), '--out', str(Path(folder, 'run'))]
            found = [measure(command, Path(folder, 'cache'), args.limit)
                     for command in (inspect, inspect, train)]
            yield Row(
                f'inspect, again, train {args.steps} steps of {batch}: {count:,} episodes of '
                f'{args.frames} frames of {side} px', '; '.join(
                    f'{seconds:.0f} s, {memory / 1e6:,.0f} MB' for seconds, memory in found),
                max(memory for _, memory in found) / written,
                f'the recording, {written / 1e9:.1f} GB',
                f'within {args.limit / 1e9:g} GB', written > args.limit,
                'the size of the recording')


def write(bag, count, side, frames):
    """Write a recording, its files at the same time; return its bytes."""
    bag.mkdir()
    for _, get in run_tasks([Work(f'file {number}', write_file, (
            bag / f'bag_{number}.mcap', range(number, count, FILES), side, frames))
                             for number in range(FILES)]):
        get()
    write_metadata(bag)
    return sum(file.stat().st_size for file in bag.glob('*.mcap'))


def write_file(file, seeds, side, frames):
    """Write a file of a recording."""
    with EpisodeWriter(file, 'none') as writer:
        for seed in seeds:
            writer.write(make_episode(seed, side, frames))


def measure(command, cache, limit):
    """
    Run a command of tap_ros with this cache; return the s and the bytes that it took.

    :raises RuntimeError: with what it said, where it fails, as with a limit that is too small.
    """
    begin, most = time.perf_counter(), 0
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, '-m', 'tap_ros', *command], stdout=said, stderr=said,
            env=os.environ | {'TAP_ROS_CACHE': str(cache)},
            preexec_fn=partial(resource.setrlimit, resource.RLIMIT_DATA, (limit, limit)))
        while process.poll() is None:
            most = max(most, held(process.pid))
            time.sleep(PERIOD_S)
        if process.returncode:
            said.seek(0)
            raise RuntimeError(f'{" ".join(command)}: {said.read().decode()}')
    return time.perf_counter() - begin, most


def held(pid):
    """Return the bytes that a process and its children hold beside mapped files."""
    total = 0
    with suppress(OSError):  # it has ended
        status = Path(f'/proc/{pid}/status').read_text()
        total += 1024 * sum(map(int, re.findall(r'RssAnon:\s+(\d+)', status)))
        for children in Path(f'/proc/{pid}/task').glob('*/children'):
            total += sum(map(held, children.read_text().split()))
    return total
