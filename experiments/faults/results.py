# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of faults.json: written one by one, so that an interrupted run goes on."""

import json
import os
from pathlib import Path
import platform
import subprocess
import time

from tap_ros.errors import TapError
from tap_ros.files import write_rows

FILE = 'faults.json'
COMMAND = 'python -m tap_ros evaluate faults'


def load_rows(folder):
    """
    Read the rows that are there.

    :param folder: of faults.json, which need not be there.
    :return: {name of the fault: row}.
    :raises TapError: when the file cannot be read.
    """
    path = Path(folder) / FILE
    if not path.exists():
        return {}
    try:
        return {row['fault']: row for row in json.loads(path.read_text())}
    except (ValueError, TypeError, KeyError) as error:
        raise TapError(f'{path}: not a list of rows ({error}); remove it or mend it') from error


def save_row(folder, row, order):
    """
    Put a row into faults.json, in one step.

    The file is read anew: another run may have written rows meanwhile.

    :param folder: of the file; made if it is not there.
    :param row: dict with the name of its fault.
    :param order: names of all faults, in the order of the file.
    """
    path = Path(folder) / FILE
    known = {name: rank for rank, name in enumerate(order)}
    rows = {**load_rows(folder), row['fault']: row}
    listed = sorted(rows.values(), key=lambda row: known.get(row['fault'], len(known)))
    write_rows(path, listed)


def is_done(row, share):
    """Tell whether a row says all that this share of the trials would."""
    return row is not None and not row.get('error') and row['share'] >= share


def make_row(job, seconds, about):
    """Return the row of a finished Job; see also failed_row."""
    figure = job.figure()
    return {
        'fault': job.fault.name, 'tried': job.tried, 'held': job.held,
        'figure': None if figure is None else round_figure(figure), 'unit': job.fault.unit,
        'command': command(job), 'why_not': job.why_not(), 'note': job.note,
        'share': job.share, 'seconds': round(seconds, 1), **about}


def failed_row(job, seconds, about, error):
    """Return the row of a Job that an exception ended; what was tried before is lost."""
    return {**make_row(job, seconds, about), 'tried': job.count, 'held': 0, 'error': True,
            'why_not': f'the trials could not be made: {error}'}


def round_figure(value):
    """Return four significant digits; text for what JSON has no number for."""
    return float(f'{value:.4g}') if abs(value) < float('inf') else str(value)


def command(job):
    """Return the command that makes a row again."""
    share = '' if job.share == 1 else f' --share {job.share:g}'
    return f'{COMMAND} --only {job.fault.name}{share} --again'


def describe_machine():
    """Return what every row says of the machine and the code."""
    return {'machine': f'{cpu_model()}, {os.cpu_count()} cores',
            'date': time.strftime('%Y-%m-%d'), 'commit': commit()}


def cpu_model():
    """Return the name of the processor."""
    try:
        for line in Path('/proc/cpuinfo').read_text().splitlines():
            if line.startswith('model name'):
                return line.split(':', 1)[1].strip()
    except OSError:
        pass
    return platform.machine()


def commit():
    """Return the commit of this package, with a plus where files differ from it; may be empty."""
    def git(*words):
        run = subprocess.run(['git', *words], cwd=Path(__file__).parent, text=True,
                             stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        return run.stdout.strip() if run.returncode == 0 else ''
    try:
        changed = git('status', '--porcelain', '--untracked-files=no', '--', '*.py')
        return git('rev-parse', '--short', 'HEAD') + ('+' if changed else '')
    except OSError:
        return ''
