# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All benchmarks, one after the other: the data of docs/speed.md."""

from dataclasses import asdict, dataclass
import importlib
import json
import os
from pathlib import Path
import platform
import re
import time

from tap_ros.base.files import write_atomically
import torch

PARTS = ('collect', 'recording', 'growth', 'training', 'planning', 'nodes.service', 'nodes.start',
         'nodes.busy')


@dataclass(frozen=True)
class Options:
    """
    Options of all benchmarks together.

    :param out: file for what was measured.
    """

    out: str = 'runs/bench/speed.json'


def run(args):
    """Measure everything with default options, and write what was measured."""
    rows = []
    for name in PARTS:
        print(f'== bench {name.split(".")[-1]}', flush=True)
        part = importlib.import_module(f'experiments.bench.{name}')
        rows += part.run(part.Options())
    write_atomically(args.out, json.dumps({
        'command': 'make bench', 'date': time.strftime('%Y-%m-%d'),
        'machine': f'{len(os.sched_getaffinity(0))} cores, {processor()}',
        'python': platform.python_version(), 'torch': torch.__version__,
        'rows': [asdict(row) for row in rows]}, indent=1, default=bool) + '\n')
    print(f'wrote {args.out}')


def processor():
    """Return what kind of processor this is, and whether it multiplies matrices of bfloat16."""
    told = Path('/proc/cpuinfo').read_text()
    name = re.search(r'model name\s*: (.*)', told)
    return (name[1] if name else platform.machine()) + ' with AMX' * ('amx_bf16' in told)
