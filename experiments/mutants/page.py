# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page about mutants in docs/results, and the same as data."""

from collections import Counter
import json
import os
from pathlib import Path
import platform
import time
import tomllib

from experiments.mutants.tool import BUDGET_S, VERSION
from tap_ros.files import write_atomically

FOLDER = Path('docs/results')
REASONS = Path(__file__).with_name('reasons.toml')
Z = 1.96  # of a 95% interval
NO_REASON = 'a test is missing'
PAGE = """\
# Which changes of the code the tests notice

Made by `make mutants{arguments}` with [mutmut](https://mutmut.readthedocs.io) {version}, commit
{commit}, {date}; as data: [mutants.json](mutants.json).

**{killed} of {tried} mutants are killed: {rate}.** {scope}

A mutant is one small change of one function: another operator, number, name, argument or string.
It is killed when a test fails with it, or never ends. Only tests that reach the function are run,
without those marked `slow`, the fastest first and for at most {budget} s in all, by their time
without a mutant; one is always run.

Left out, by rule: what an error says (all below `raise`), calls of `len` and `isinstance`, code
outside functions, `train_command.py` (names and help of options), and functions with decorators
other than `staticmethod`, `classmethod`, `torch.no_grad` and `torch.inference_mode`.

| file | mutants | tried | killed | share (95% interval) |
|---|---:|---:|---:|---:|
{rows}

## Survivors

{survivors}
"""


def write_page(chosen, total, seed):
    """
    Write mutants.md and mutants.json.

    :param chosen: list of Mutant, those that were to be tried.
    :param total: {file: number of its mutants}.
    :param seed: of the draw.
    """
    tried = [mutant for mutant in chosen if mutant.status != 'not checked']
    about = {'machine': f'{platform.machine()}, {os.cpu_count()} cores',
             'date': time.strftime('%Y-%m-%d'), 'commit': ''}
    every = sum(total.values())
    sampled = len(chosen) < every
    found = {
        'tool': f'mutmut {VERSION}', **about, 'seed': seed if sampled else None,
        'mutants': every, 'chosen': len(chosen), 'tried': len(tried),
        'killed': sum(mutant.killed for mutant in tried),
        'statuses': Counter(mutant.status for mutant in tried),
        'files': [{'file': file, 'mutants': number, **count(tried, file)}
                  for file, number in sorted(total.items())],
        'survivors': survivors(tried)}
    write_atomically(FOLDER / 'mutants.json', json.dumps(found, indent=1) + '\n')
    write_atomically(FOLDER / 'mutants.md', make_page(found))


def count(tried, file):
    """Return how many mutants of a file were tried and how many killed."""
    killed = [mutant.killed for mutant in tried if mutant.file == file]
    return {'tried': len(killed), 'killed': sum(killed)}


def survivors(tried):
    """Return a row for every mutant that no test killed, with the reason that was noted."""
    reasons = {(row['function'], row['change']): row['reason']
               for row in tomllib.loads(REASONS.read_text()).get('survivor', ())}
    rows = []
    for mutant in tried:
        if not mutant.killed:
            before, after = mutant.changed_lines()
            rows.append({'mutant': mutant.name, 'file': mutant.file, 'function': mutant.function,
                         'status': mutant.status, 'before': before, 'after': after,
                         'reason': reasons.get((mutant.function, after), NO_REASON)})
    return rows


def make_page(found):
    """Return the page, Markdown, of what mutants.json holds."""
    sampled = found['seed'] is not None
    rest = '' if found['tried'] == found['chosen'] else (
        f' Not tried yet: {found["chosen"] - found["tried"]}.')
    scope = (f'They were drawn at random, with seed {found["seed"]}, from {found["mutants"]}. '
             'Once tests are written for the survivors of a draw, another seed tells the rate.'
             if sampled else 'These are all there are.') + rest
    arguments = f' ARGS="--sample {found["chosen"]} --seed {found["seed"]}"' if sampled else ''
    return PAGE.format(
        arguments=arguments, budget=BUDGET_S, version=found['tool'].split()[1],
        commit=found['commit'], date=found['date'],
        killed=found['killed'], tried=found['tried'], scope=scope,
        rate=share(found['killed'], found['tried'], found['mutants']),
        rows='\n'.join(f'| `{row["file"]}` | {row["mutants"]} | {row["tried"]} | {row["killed"]} '
                       f'| {share(row["killed"], row["tried"], row["mutants"])} |'
                       for row in found['files']),
        survivors='\n'.join(_survivor(row) for row in found['survivors']) or 'None.')


def share(killed, tried, total):
    """Return a rate in words, with Wilson's interval unless all mutants were tried."""
    if not tried:
        return '-'
    words = f'{killed / tried:.0%}'
    if tried == total:
        return words
    middle = (killed + Z ** 2 / 2) / (tried + Z ** 2)
    half = Z / (tried + Z ** 2) * (killed * (tried - killed) / tried + Z ** 2 / 4) ** 0.5
    return f'{words} ({max(middle - half, 0):.0%} to {min(middle + half, 1):.0%})'


def _survivor(row):
    before, after = (' '.join(row[name].split()).replace('`', "'") for name in ('before', 'after'))
    place = f'{Path(row["file"]).name}, `{row["function"]}`'
    change = f'`{before}` -> `{after}`' if after else f'`{before}` left out'
    status = '' if row['status'] == 'survived' else f' ({row["status"]})'
    return f'- {place}{status}: {change}: {row["reason"]}'
