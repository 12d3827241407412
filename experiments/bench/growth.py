# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What recordings of many episodes, and of large pictures, cost: to inspect them and to train.

Each part is a command in a process of its own. Its memory is the most that it and its children
hold at once beside mapped files, which the system takes back: a recording may be larger than that.
"""

from contextlib import suppress
from dataclasses import dataclass
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
import time

from experiments.bench.recording import make_episode
from experiments.bench.rows import Row, show
from tap_ros.recording.writer import EpisodeWriter, write_metadata

AIM_BYTES = 2 * 10**9  # of memory, whatever the size of a recording
PERIOD_S = 0.05  # between two looks at a process


@dataclass(frozen=True)
class Options:
    """
    Options of this benchmark.

    :param episodes: of pictures of 64 pixels a side.
    :param large: episodes of pictures of 256 pixels a side.
    :param frames: of each episode.
    :param steps: of the trainings.
    :param folder: where recordings and cache are written; by default a temporary one.
    """

    episodes: int = 10_000
    large: int = 500
    frames: int = 12
    steps: int = 20
    folder: str = ''


def run(args):
    """Write each recording, measure what is done with it, remove it; return rows."""
    rows = []
    for count, side, batch in ((args.episodes, 64, 24), (args.large, 256, 2)):
        with tempfile.TemporaryDirectory(dir=args.folder or None) as folder:
            bag = Path(folder, 'bag')
            written = write(bag, count, side, args.frames)
            inspect, train = ['inspect', str(bag)], [
                'train', 'predictor', str(bag), '--steps', str(args.steps), '--batch-size',
                str(batch), '--out', str(Path(folder, 'run'))]
            for what, command in (('inspect for the first time', inspect),
                                  ('inspect again', inspect),
                                  (f'train {args.steps} steps, batch {batch}', train)):
                seconds, memory = measure(command, Path(folder, 'cache'))
                rows += show([Row(
                    f'{what}: {count:,} episodes of {args.frames} frames of {side} px',
                    f'{seconds:.0f} s, {memory / 1e6:,.0f} MB of memory', memory / written,
                    f'the recording, {written / 1e9:.1f} GB',
                    f'at most {AIM_BYTES / 1e9:.0f} GB', memory <= AIM_BYTES,
                    'what is held of each frame beside its picture')])
    return rows


def write(bag, count, side, frames):
    """Write a recording of one file; return its bytes."""
    bag.mkdir()
    with EpisodeWriter(bag / 'bag_0.mcap', 'none') as writer:
        for seed in range(count):
            writer.write(make_episode(seed, side, frames))
    write_metadata(bag)
    return (bag / 'bag_0.mcap').stat().st_size


def measure(command, cache):
    """Run a command of tap_ros with this cache; return the s and the bytes that it took."""
    begin, most = time.perf_counter(), 0
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, '-m', 'tap_ros', *command], stdout=said, stderr=said,
            env=os.environ | {'TAP_ROS_CACHE': str(cache)})
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
