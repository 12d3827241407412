# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every option of every command is spelled as it always was, and does what it always did."""

import csv
from dataclasses import fields, is_dataclass
import json
from pathlib import Path
import re
import shlex

import pytest
from tap_ros.cli import main, read
from tap_ros.errors import UsageError

ROOT = Path(__file__).parents[1]
# command, words: one option with a value; value: of its setting then; default: without it, or
# 'required'; choices: the only values that it can have
with open(ROOT / 'test' / 'commands.csv') as file:
    TABLE = list(csv.DictReader(file))
NEEDED = {}  # by every command
for row in TABLE:
    NEEDED.setdefault(row['command'], [])
    if row['default'] == 'required':
        NEEDED[row['command']].append(row['words'])
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'bags' / 'README.md',
         *sorted((ROOT / 'docs').rglob('*.md')), *sorted((ROOT / 'tap_ros').rglob('*.md'))]
SHOWN = {  # one of those with the same options
    tuple(re.findall(r'--\S+', command)) or command: command.strip() for page in PAGES
    for command in re.findall(r'-m tap_ros ([^`\n;|]+?)(?: #.*)?(?=[`\n;])', page.read_text())
    if '...' not in command}.values()
IN_THE_MAKEFILE = ['demo --scenes 20', 'paper --jobs 2 --scale full --list', 'bench',
                   'evaluate faults --only camera-silent', 'bench planning']


def settings(line):
    """Return all settings of a command line by name."""
    return dict(flat(read(shlex.split(line))[1]))


def flat(options):
    """Give the name and the value of each setting, also of those in parts."""
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from flat(value)
        else:
            yield field.name, plain(value)


def plain(value):
    """Return a value as JSON would have it, without the place of this checkout."""
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value.replace(f'{ROOT}/', '') if isinstance(value, str) else value


def name(row):
    return f'{row["command"]} {row["words"]}'


@pytest.mark.parametrize('row', TABLE, ids=name)
def test_an_option_sets_what_it_always_set(row):
    options = row['words'].count('--') - 2 * ('--only c' in row['words'])
    others = [words for words in NEEDED[row['command']] if words != row['words']]
    line, value = ' '.join([row['command'], *others]), json.loads(row['value'])
    if row['default'] == 'required':
        assert value in settings(f'{line} {row["words"]}').values()
        with pytest.raises(UsageError):
            settings(line)
        return
    before, default = settings(line), json.loads(row['default'])
    changed = {name: (before[name], now)
               for name, now in settings(f'{line} {row["words"]}').items() if before[name] != now}
    if value == default:
        assert not changed
    else:
        assert [default, value] in map(list, changed.values()) and len(changed) <= max(1, options)


@pytest.mark.parametrize('row', [row for row in TABLE if row['choices']], ids=name)
def test_an_option_takes_its_choices_alone(row, capsys):
    first, *other = row['words'].split(' --')
    option = first.split()[0]
    line = ' '.join([row['command'], *NEEDED[row['command']], *(f'--{each}' for each in other),
                     option])
    for choice in row['choices'].split():
        assert choice in str(settings(f'{line} {choice}'))
    assert main(shlex.split(f'{line} else')) == 2
    error, = capsys.readouterr().err.splitlines()
    assert option in error and row['choices'].replace(' ', ', ') in error and "'else'" in error


@pytest.mark.parametrize('command', [*SHOWN, *IN_THE_MAKEFILE])
def test_commands_that_are_shown_are_valid(command):
    if '--' in command or command in IN_THE_MAKEFILE:
        assert read(shlex.split(command))
    else:  # a command is mentioned, what it needs is left out
        assert any(known.startswith(command.split(' bags')[0].strip()) for known in NEEDED)
