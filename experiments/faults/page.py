# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page about faults, in Markdown, from the rows of faults.json."""

from pathlib import Path

from experiments.faults.results import COMMAND, FILE, load_rows
from tap_ros.files import write_atomically

PAGE = 'faults.md'
INTRODUCTION = f"""\
# What happens when something goes wrong

Made by `{COMMAND}` (`make faults`); as data: [{FILE}]({FILE}). What else the machine did,
and which rows are older than a change of what they test, was noted by hand.

Each row is a fault that was injected into real nodes, processes of their own that talk over DDS,
or into real files. *Held* counts the trials in which the promise was kept. A row that falls short
stands here as it is, with the reason below the table; *commit* is the code that was tried.
"""


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
    parts = [INTRODUCTION]
    known = {fault.name for faults in groups.values() for fault in faults}
    for title, faults in groups.items():
        found = [fault for fault in faults if fault.name in rows]
        if found:
            parts += [f'## {title}\n', _table(found, rows), *_shortfalls(found, rows),
                      *(_explain(fault) for fault in found)]
    other = [rows[name] for name in rows if name not in known]
    if other:
        parts.append('Rows of faults that this version does not have: '
                     + ', '.join(f'`{row["fault"]}`' for row in other) + '.\n')
    missing = [fault.name for faults in groups.values() for fault in faults
               if fault.name not in rows]
    if missing:
        parts.append('Not measured yet: ' + ', '.join(f'`{name}`' for name in missing) + '.\n')
    if rows:
        parts += ['## Commands\n', *(f'    {row["command"]}' for row in rows.values()), '',
                  _machines(rows.values())]
    return '\n'.join(parts) + '\n'


def _table(faults, rows):
    lines = ['| what goes wrong | tried | held | measured | | commit |',
             '|---|---:|---:|---:|---|---|']
    for fault in faults:
        row = rows[fault.name]
        held = f'{row["held"]}' if row['held'] == row['tried'] else f'**{row["held"]}**'
        figure = '' if row['figure'] is None else f'{row["figure"]} {row["unit"]}'
        words = '; '.join(part for part in (
            f'{fault.figure}, {fault.summary}' if figure else '', row.get('note')) if part)
        lines.append(f'| {fault.title} | {row["tried"]} | {held} | {figure} | {words} '
                     f'| {row["commit"] or "unknown"} |')
    return '\n'.join(lines) + '\n'


def _shortfalls(faults, rows):
    lines = []
    for fault in faults:
        row = rows[fault.name]
        if row['held'] < row['tried']:
            why = row['why_not'].replace('<', '\\<')
            lines.append(f'- **{fault.title}**: {row["tried"] - row["held"]} of {row["tried"]} '
                         f'did not hold: {why}')
    return ['Falls short:\n', '\n'.join(lines) + '\n'] if lines else []


def _explain(fault):
    return f'**{fault.title}** (`{fault.name}`). {fault.meaning} *Held:* {fault.promise}\n'


def _machines(rows):
    made = dict.fromkeys(
        f'{row["machine"]}, {row["date"]}, commit {row["commit"] or "unknown"}' for row in rows)
    return 'Measured on: ' + '; '.join(made) + '.'
