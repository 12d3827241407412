# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A fault is a test that makes many trials; what came of them is a row of faults.json.

Rows of a run are written one by one, so that an interrupted run leaves those it has finished.
"""

from collections import Counter
from contextlib import contextmanager
import json
import os
from pathlib import Path
import platform
import re
import subprocess
import time

from experiments.paper.figures import COLOURS, INK, new_figure, to_png
import pytest
from tap_ros.base.errors import TapError
from tap_ros.base.files import write_atomically, write_rows
from tap_ros.base.text import escaped, listing

ROOT = Path(__file__).parents[2]
MAX_REASONS = 4
HEAD = """\
# Faults

Each line gives a fault of real nodes (during a goal, unless it says otherwise) or of a disk; what
must happen; in how many of the trials it did, without a traceback or an unexplained error in a
log; and the worst trial, or the least or median where it says so. Made by `{command}` in
{minutes:.0f} minutes, {dates}, commit {commits}, on {machines}; data:
[faults.json](faults.json).

![slowest reaction of all trials (bars), and what was promised (lines)](faults.png)

"""


def fault(injected, promise, count, figure='', summary=max):
    """
    Mark a test as a fault.

    :param injected: what goes wrong, a few words.
    :param promise: what must happen in a trial that counts as held.
    :param count: how many trials the whole run makes.
    :param figure: what is measured in a trial, unit first; empty if nothing is.
    :param summary: which of the trials' figures is shown.
    """
    return pytest.mark.fault(injected=injected, promise=promise, count=count, figure=figure,
                             summary=summary)


class Trials:
    """
    The trials of one fault.

    :param mark: keywords of `fault`.
    :param share: of the fault's count that is tried; at least one trial is made.
    :param patience: factor of what a promise says in seconds; more than 1 on a machine that does
        something else meanwhile.
    :param wrong: says what is wrong in the logs of nodes since it was asked before, '' if nothing.
    :ivar note: for the row, beside the figure.
    """

    def __init__(self, mark, share, patience, wrong=str):
        self.mark, self.share, self.patience, self.wrong = mark, share, patience, wrong
        self.count = max(1, round(mark['count'] * share))
        self.tried = self.held = 0
        self.note = ''
        self.figures, self.reasons = [], Counter()
        self._begin = time.monotonic()

    def __iter__(self):
        yield from range(self.count)

    @contextmanager
    def one(self):
        """
        Take down a trial.

        It held if the with-block raises neither assertion nor error, and no log has one.
        """
        try:
            yield
            why = self.wrong()
            assert not why, why
        except (AssertionError, TapError, pytest.fail.Exception) as error:
            self.record(str(error).split('\nassert ')[0] or 'no reason was given')
        else:
            self.record()

    def record(self, why='', times=1):
        """
        Take down what came of equal trials.

        :param why: what happened instead, empty where the promise held.
        :param times: of how many.
        """
        self.tried += times
        if why:
            self.reasons[escaped(why, 200)] += times
        else:
            self.held += times

    def measured(self, figure):
        """Take down what was measured in a trial."""
        self.figures.append(float(figure))

    def why_not(self):
        """Return the most frequent reasons why the promise did not hold, in one line."""
        alike, examples = Counter(), {}
        for why, times in self.reasons.items():
            key = re.sub(r'\d+', '#', why)  # reasons that differ in numbers only count as one
            alike[key] += times
            examples.setdefault(key, why)
        return '; '.join(f'{times} times: {examples[key]}'
                         for key, times in alike.most_common(MAX_REASONS))

    def row(self, name, error=None):
        """Return the row of a fault, after an exception if one ended it."""
        figure = self.mark['summary'](self.figures) if self.figures else None
        if error is not None:
            self.record(f'the trials were ended by {type(error).__name__}: {error}')
        return {
            'fault': name, 'injected': self.mark['injected'], 'promise': self.mark['promise'],
            'tried': self.tried, 'held': self.held,
            'figure': figure if figure is None else round_figure(figure),
            'what': self.mark['figure'], 'note': self.note, 'why_not': self.why_not(),
            'share': self.share, 'seconds': round(time.monotonic() - self._begin, 1),
            **describe_machine()}


def round_figure(value):
    """Return four significant digits; text for what JSON has no number for."""
    return float(f'{value:.4g}') if abs(value) < float('inf') else str(value)


def save(folder, row):
    """
    Put a row into faults.json of a folder, in place of an older one, and write the page anew.

    :param folder: of faults.json, faults.md and faults.png.
    :param row: of Trials.row.
    """
    path = Path(folder) / 'faults.json'
    rows = {old['fault']: old for old in json.loads(path.read_text())} if path.exists() else {}
    rows[row['fault']] = row
    write_rows(path, rows.values())
    write_atomically(path.with_suffix('.png'), draw(list(rows.values())))
    write_atomically(path.with_suffix('.md'), page(rows.values()))


def draw(rows):
    """Return a PNG of the slowest reactions, and of what was promised, in seconds."""
    found = [(row['fault'], row['figure'], float(promised[1])) for row in rows
             if row['what'].startswith('s until') and isinstance(row['figure'], float)
             and 'median' not in row['what']
             and (promised := re.search(r'([\d.]+) s\b', row['promise']))]
    figure, ((axis,),) = new_figure(3, 1)
    axis.barh(range(len(found)), [seconds for _, seconds, _ in found], color=COLOURS['ours'])
    for n, (_, _, promised) in enumerate(found):
        axis.plot([promised, promised], [n - 0.45, n + 0.45], color=COLOURS['genmin'])
    axis.set_yticks(range(len(found)), [name for name, *_ in found])
    axis.invert_yaxis()
    axis.set(xscale='log', xlim=(0.05, 20))
    axis.set_xlabel('s', color=INK)
    return to_png(figure)


def page(rows):
    """Return the page of all rows; rows of the same fault in several forms share a line."""
    lines, rows = {}, list(rows)
    for row in rows:
        lines.setdefault((row['injected'], row['promise']), []).append(row)
    missed = [f'- {row["injected"]}: {row["held"]} of {row["tried"]}.\n' for row in rows
              if row['held'] < row['tried']]
    share = min(row['share'] for row in rows)  # of the trials
    command = 'make faults REPORT=docs/results' + (
        f' ARGS="--share {share:g}"' if share < 1 else '')
    minutes = sum(row['seconds'] for row in rows) / 60
    head = HEAD.format(command=command, minutes=minutes, **{
        f'{key}s': listing(sorted({row[key] for row in rows}))
        for key in ('date', 'commit', 'machine')})
    return head + ''.join(_line(*texts, rows) for texts, rows in lines.items()) + ''.join(
        ['\n## What was missed\n\n', *missed] if missed else '')


def _line(injected, promise, rows):
    """Return one line of the page."""
    tried, held = (sum(row[key] for row in rows) for key in ('tried', 'held'))
    figures = [row['figure'] for row in rows if row['figure'] is not None]
    seen = ', '.join(dict.fromkeys(  # equal ones once
        f'{figure:.3g}' if isinstance(figure, float) else figure for figure in figures))
    what = re.sub(r'^s (?:until|for) [a-z ]+', 's ', rows[0]['what']).strip()  # 's (median)'
    share = f'{held}/{tried}'
    parts = [share if held == tried else f'**{share}**',
             f'{seen} {what}'.strip() if figures else '', *(row['why_not'] for row in rows)]
    words = '; '.join(filter(None, parts)).replace('<', '\\<')
    return f'- **{injected}**: {promise}. {words}\n'


def describe_machine():
    """Return what every row says of the machine and the code."""
    cpu = re.search(r'model name\s*: (.*)', Path('/proc/cpuinfo').read_text())
    return {'machine': f'{cpu[1] if cpu else platform.machine()}, {os.cpu_count()} cores',
            'date': time.strftime('%Y-%m-%d'),
            'commit': _git('rev-parse', '--short', 'HEAD') + (
                '+' if _git('status', '--porcelain', '-uno', '--', '*.py') else '')}


def _git(*words):
    """Return what git says of this checkout."""
    run = subprocess.run(['git', *words], cwd=ROOT, text=True, stdout=subprocess.PIPE,
                         stderr=subprocess.DEVNULL)
    return run.stdout.strip()
