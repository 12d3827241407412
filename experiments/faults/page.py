# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the page about faults shows; its sentences stand in templates/faults.md.j2."""

from pathlib import Path

from experiments.faults.results import COMMAND, FILE, load_rows
from experiments.pages import render
import pandas as pd
from tap_ros.files import write_atomically

PAGE = 'faults.md'


def write_page(folder, groups):
    """
    Write the page from faults.json alone.

    :param folder: of faults.json, and of the page.
    :param groups: {title: list of Fault}, in the order of the page.
    """
    write_atomically(Path(folder) / PAGE, make_page(load_rows(folder), groups))


def make_page(rows, groups):
    """
    Return the page.

    :param rows: {name: row}.
    :param groups: {title: list of Fault}.
    :return: Markdown.
    """
    rows = {name: {**row, 'commit': row['commit'] or 'unknown'} for name, row in rows.items()}
    found = {title: [fault for fault in faults if fault.name in rows]
             for title, faults in groups.items()}
    names = {fault.name for faults in groups.values() for fault in faults}
    return render(
        'faults/templates/faults.md.j2', command=COMMAND, file=FILE, rows=rows,
        groups=[(title, faults, _table(faults, rows)) for title, faults in found.items()],
        gone=[row['fault'] for name, row in rows.items() if name not in names],
        missing=[fault.name for faults in groups.values() for fault in faults
                 if fault.name not in rows],
        machines=dict.fromkeys(f'{row["machine"]}, {row["date"]}, commit {row["commit"]}'
                               for row in rows.values()))


def _table(faults, rows):
    """Tabulate the faults of a group; the fifth column says what was measured."""
    lines = []
    for fault in faults:
        row = rows[fault.name]
        held, measured = f'{row["held"]}', row['figure'] is not None
        lines.append({
            'what goes wrong': fault.title, 'tried': row['tried'],
            'held': held if row['held'] == row['tried'] else f'**{held}**',
            'measured': f'{row["figure"]} {row["unit"]}' if measured else '',
            '': '; '.join(filter(None, (f'{fault.figure}, {fault.summary}' if measured else '',
                                        row.get('note')))),
            'commit': row['commit']})
    return pd.DataFrame(lines)
