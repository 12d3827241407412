# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every option of every command: spelling and effect stay, and --help explains it."""

import csv
from dataclasses import fields, is_dataclass
import json
from pathlib import Path
import re
import shlex
import subprocess
import sys

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
    if '...' not in command and '--tyro' not in command}.values()
IN_THE_MAKEFILE = ['demo --scenes 20', 'paper --jobs 2 --scale full --list', 'bench',
                   'bench planning']


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


@pytest.mark.parametrize('command', [*NEEDED, 'bench', 'evaluate', 'hub', ''])
def test_help_says_of_every_option_what_it_is(command, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit) as end:
        main([*command.split(), '--help'])
    assert end.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('usage: python -m tap_ros') and lines[2]
    assert max(map(len, lines[1:])) <= 80
    text = ' '.join(re.sub(r'[^\x20-\x7e]', ' ', ' '.join(lines[3:])).split())
    for row in TABLE:
        option = row['words'].split()[0]
        if row['command'] == command and option.startswith('--'):
            shown = re.findall(rf'{option}\b[ ,](.*?)\((?:default|required)', text)
            assert any(re.search('[a-z]{2,} .*[a-z]{2,}', re.sub(
                r'--[\w-]+,?|\{.*?\}|\[.*\]|[A-Z:=]+', ' ', each)) for each in shown), option


@pytest.mark.parametrize('line, named', [
    ('', 'expected one of collect, import-bair'), ('colect', 'colect'),
    ('evaluate', 'planning'), ('evaluate nothing', 'nothing'), ('bench nothing', 'nothing'),
    ('train other', 'other'), ('collect', '--out'), ('collect --out', '--out'),
    ('collect --out a --episodes many', '--episodes: expected INT'),
    ('collect --out a --nothing 3', '--nothing'), ('collect --out a b', 'b'),
    ('import-bair --out a', 'PATH'), ('paper --only', '--only'), ('paper --seeds 1 x', '--seeds'),
    ('train predictor --out a', 'BAG'),
    ('--tyro-print-completion', 'bash'), ('--tyro-print-completion sh', 'bash'),
    ('collect --out a --seed "\x1b[31m\n"', r'\x1b'), ('collect --out a --task "\x1b\n"', r'\x1b'),
    ('collect --out a "\x1b\n"', r'\x1b')])
def test_words_that_are_wrong_are_named_in_one_line(line, named, capsys):
    assert main(shlex.split(line)) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1 and error.startswith('error: ') and named in error
    assert '\x1b' not in error


@pytest.mark.parametrize('command, needed', [
    ('', ()), ('evaluate', ()), ('bench', ()), ('train predictor', ()), ('train forward', ()),
    ('evaluate planning', ('mujoco',)), ('hub push', ()), ('hub pull', ())])
def test_help_comes_without_what_takes_long_to_import(command, needed):
    slow = {'torch', 'mujoco', 'rclpy', 'cv2', 'tensorboard', 'huggingface_hub'} - {*needed}
    run = subprocess.run([sys.executable, '-c', (
        'import atexit, sys; from tap_ros.cli import main; '
        f'atexit.register(lambda: print("slow:", {slow} & set(sys.modules))); '
        'main(sys.argv[1:] + ["--help"])'), *command.split()], capture_output=True, text=True)
    assert run.returncode == 0 and run.stdout.splitlines()[-1] == 'slow: set()'


def test_a_shell_completes_commands_options_and_choices(tmp_path):
    with pytest.raises(SystemExit):
        main(['--tyro-write-completion', 'bash', str(tmp_path / 'tap_ros')])
    complete = (
        'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); '
        'COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}; '
        '$(complete -p tap_ros | sed "s/.*-F //; s/ .*//"); echo "${COMPREPLY[@]}"')

    def completed(*words):
        return subprocess.run(['bash', '-c', complete, 'bash', tmp_path / 'tap_ros', 'tap_ros',
                               *words], capture_output=True, text=True).stdout.split()

    assert completed('ev') == ['evaluate']
    assert {'prediction', 'planning'} <= set(completed('evaluate', ''))
    assert completed('train', 'predictor', '--learning') == ['--learning-rate']
    assert completed('collect', '--engine', '') == ['local', 'ray']
