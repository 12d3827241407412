# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Try faults one after another, write a row for each at once, and the page in the end."""

from pathlib import Path
import shutil
import tempfile
import time
import traceback

from experiments.faults.fault import Job
from experiments.faults.page import write_page
from experiments.faults.results import (
    describe_machine,
    failed_row,
    is_done,
    load_rows,
    make_row,
    save_row,
)
from tap_ros.errors import ConfigError
from tap_ros.text import escaped


def run_faults(groups, out, only=(), share=1.0, again=False, rig=None, progress=True,
               patience=1.0):
    """
    Try faults.

    :param groups: {title: list of Fault}.
    :param out: folder of faults.json and the page.
    :param only: names of faults; empty: all.
    :param share: of each fault's count, above 0; at least one trial is made.
    :param again: also try what faults.json says already.
    :param rig: handed to each Job.
    :param progress: whether to show bars.
    :param patience: see Job.
    :return: the rows, those that were there included, of the faults chosen.
    :raises ConfigError: for an unknown name or a bad share.
    """
    if not 0 < share <= 1:
        raise ConfigError(f'--share is {share:g}; expected more than 0, at most 1')
    faults = choose(groups, only)
    order = [fault.name for group in groups.values() for fault in group]
    about = describe_machine()
    rows = []
    for fault in faults:
        row = load_rows(out).get(fault.name)
        if again or not is_done(row, share):
            row = _try(fault, share, rig, progress, patience, about)
            save_row(out, row, order)
            write_page(out, groups)
            print(summary(row), flush=True)
        rows.append(row)
    write_page(out, groups)
    return rows


def choose(groups, only):
    """Return the Faults of these names, or all; raise ConfigError for an unknown one."""
    known = {fault.name: fault for group in groups.values() for fault in group}
    unknown = [name for name in only if name not in known]
    if unknown:
        raise ConfigError(f'--only: there is no fault {escaped(", ".join(unknown))}; valid: '
                          + ', '.join(known))
    return [known[name] for name in only] if only else list(known.values())


def summary(row):
    """Return a row in one line."""
    figure = '' if row['figure'] is None else f', {row["figure"]} {row["unit"]}'
    why = f': {row["why_not"]}' if row['held'] < row['tried'] else ''
    return (f'{row["fault"]:<28} {row["held"]} of {row["tried"]} held{figure}, '
            f'{row["seconds"]:.0f} s{why}')


def _try(fault, share, rig, progress, patience, about):
    """Return the row of one fault, whatever happens meanwhile."""
    folder = Path(tempfile.mkdtemp(prefix='faults-'))
    job = Job(fault, share, folder, rig, progress, patience)
    begin = time.monotonic()
    try:
        fault.run(job)
        return make_row(job, time.monotonic() - begin, about)
    except Exception as error:
        traceback.print_exc()
        reason = escaped(f'{type(error).__name__}: {error}')
        return failed_row(job, time.monotonic() - begin, about, reason)
    finally:
        job.close()
        shutil.rmtree(folder, ignore_errors=True)
