# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All benchmarks, and their rows in docs/results/speed.json and on docs/speed.md.

A row is written as soon as it is measured, in the place of the one of this machine that was there.
So what is interrupted goes on, and neither other parts nor other machines' rows change.
"""

from dataclasses import asdict, dataclass
import importlib
import json
import os
from pathlib import Path
import platform
import re
import subprocess
import time

from experiments import tables
from experiments.bench.rows import show
from tap_ros.base.files import write_atomically
import torch
from tyro import conf

PARTS = ('collect', 'recording', 'growth', 'training', 'planning', 'service', 'start', 'busy')
OF_NODES = ('service', 'start', 'busy')
WIDEST = {'amx_bf16': 'AMX', 'avx512_bf16': 'bfloat16', 'avx512f': 'AVX-512', 'avx2': 'AVX2'}


@dataclass(frozen=True)
class Options:
    """
    Options of all benchmarks together.

    :param anew: measure also the parts that this code has measured on this machine.
    """

    anew: conf.FlagCreatePairsOff[bool] = False


def run(args):
    """Measure all parts with default options; those that are measured are left out."""
    begin = time.monotonic()
    for number, name in enumerate(PARTS, 1):
        print(f'== {number} of {len(PARTS)}: bench {name}, after '
              f'{(time.monotonic() - begin) / 60:.1f} min', flush=True)
        if not args.anew and is_measured(name):
            print('measured by this code on this machine; --anew repeats it')
        else:
            measure(name, module(name).Options())


def module(name):
    """Import the part of this name."""
    return importlib.import_module(
        f'experiments.bench.{"nodes." * (name in OF_NODES)}{name}')


def measure(name, options):
    """
    Measure one part, print its rows, and keep them unless an option is not the default.

    :param name: of PARTS.
    :param options: Options of the part.
    """
    part, origin, found = module(name), made_by(), []
    keep = change if options == part.Options() else lambda *_: None
    machine = origin['machine']
    keep(name, machine, found, False)
    for row in part.run(options):
        show(row)
        found.append({**asdict(row), 'reached': bool(row.reached), 'part': name, **origin})
        keep(name, machine, found, False)
    keep(name, machine, found, True)


def change(name, machine, found, is_all):
    """Put what a machine found of a part so far into the data, and into the page's table."""
    data = tables.measured_speed()
    parts = {part: [row for row in data['rows'] if row['part'] == part] for part in PARTS}
    new = {row['what']: row for row in found}
    kept = [row if row['machine'] != machine else new.pop(row['what'], None if is_all else row)
            for row in parts[name]]
    parts[name] = [row for row in kept if row] + list(new.values())
    data['rows'] = sum(parts.values(), [])
    unfinished = [name, machine]
    data['unfinished'] = [one for one in data['unfinished'] if one != unfinished] + [
        unfinished] * (not is_all)
    write_atomically(tables.SPEED, json.dumps(data, indent=1) + '\n')
    write_atomically(tables.page_path('speed'), tables.filled('speed'))


def is_measured(name):
    """Return whether all rows of a part are of this machine and code."""
    data, origin = tables.measured_speed(), made_by()
    rows = [row for row in data['rows']
            if (row['part'], row['machine']) == (name, origin['machine'])]
    return bool(rows) and [name, origin['machine']] not in data['unfinished'] \
        and not origin['commit'].endswith('+') \
        and all(row[key] == origin[key] for row in rows for key in ('commit', 'torch'))


def made_by():
    """Return machine, date, and version of the code, with a + where it has been changed since."""
    def git(*words):
        done = subprocess.run(['git', *words, '--', '.', ':!docs'], cwd=tables.RESULTS.parents[1],
                              capture_output=True, text=True)
        return done.stdout.strip()

    changed = git('status', '--porcelain', '--untracked-files=no')
    return {'machine': f'{len(os.sched_getaffinity(0))} cores, {processor()}',
            'date': time.strftime('%Y-%m-%d'),
            'commit': git('log', '-1', '--format=%h') + '+' * bool(changed),
            'torch': torch.__version__}


def processor():
    """Return what kind of processor this is, and what it computes with."""
    told = Path('/proc/cpuinfo').read_text()
    name = re.search(r'model name\s*: (.*)', told)
    widest = next((title for flag, title in WIDEST.items() if f' {flag} ' in told), '')
    return (name[1] if name else platform.machine()) + (f' with {widest}' if widest else '')
