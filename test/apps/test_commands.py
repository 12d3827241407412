# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of all commands and their options, and that those shown in the pages are valid."""

from contextlib import suppress
from dataclasses import fields, is_dataclass, MISSING
from functools import cache
from pathlib import Path
import re
import shlex
import subprocess
import sys

from experiments.__main__ import LINE
import pytest
from tap_ros.__main__ import LINE as TAP_ROS
from tap_ros.apps.cli import main, read
from tap_ros.base.errors import ConfigError

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'bags' / 'README.md',
         *sorted((ROOT / 'docs').rglob('*.md')), *sorted((ROOT / 'tap_ros').rglob('*.md'))]
SHOWN = {  # one of those with the same options
    tuple(re.findall(r'--\S+', command)) or command: command.strip() for page in PAGES
    for command in re.findall(
        r'-m ((?:tap_ros|experiments) [^`\n;|]+?)(?: #.*)?(?=[`\n;])', page.read_text())
    if '...' not in command and '--tyro' not in command}.values()
IN_THE_MAKEFILE = ['tap_ros demo --scenes 20', 'experiments paper --jobs 2 --list',
                   'experiments bench all', 'experiments bench planning']
LINES = {'tap_ros': TAP_ROS, 'experiments': LINE}


@cache
def kinds():
    """Return the options of each command by its words, such as 'tap_ros train forward'."""
    flat = {}
    for place, line in LINES.items():
        for name, (_, load) in line.commands.items():
            flat |= {f'{place} {name} {word}': inner for word, (_, inner) in load.items()
                     } if isinstance(load, dict) else {f'{place} {name}': load}
    return {words: load().options for words, load in flat.items()}


def given_in(line):
    """Return the options that a command line gives."""
    place, *words = shlex.split(line)
    return read(LINES[place], words)[1]


def options(kind):
    """Give name and default of the fields of options, also of those in parts."""
    for field in fields(kind):
        default = field.default_factory() if field.default_factory is not MISSING else (
            field.default)
        part = next((each for each in (field.type, type(default)) if is_dataclass(each)), None)
        if part:
            yield from options(part)
        else:
            yield field.name, default


def help_of(command, capsys, monkeypatch):
    """Return the help of a command in one line."""
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit) as end:
        place, *words = command.split()
        main(LINES[place], [*words, '--help'])
    assert end.value.code == 0
    return ' '.join(re.sub(r'[^\x20-\x7e]', ' ', capsys.readouterr().out).split())


def refused(line, capsys):
    """Return what is said of words that are wrong."""
    with pytest.raises(SystemExit) as end:
        place, *words = shlex.split(line)
        main(LINES[place], words)
    assert end.value.code == 2
    return ' '.join(re.sub(r'[^\x20-\x7e]', ' ', capsys.readouterr().err).split())


def needed(kind, text):
    """Return words for the options that have no default, by their help."""
    line = ''
    for name, default in options(kind):
        if default is MISSING:
            found = re.search(rf'(--{name.replace("_", "-")})[ ,]+(\S+)', text)
            option, takes = found.groups() if found else ('', 'WORD')
            line += f' {option} {takes[1:-1].split(",")[0] if takes[0] == "{" else 7}'
    return line


@pytest.mark.parametrize('command', kinds())
def test_help_says_of_every_option_what_it_is_and_takes(command, capsys, monkeypatch):
    text = help_of(command, capsys, monkeypatch)
    assert text.startswith(f'usage: python -m {command}')
    assert not re.findall(  # code in the place of choices
        r'likewise|\w+\.py\b|see [a-z_]+\.\w+|see \w+_node', text)
    line = command + needed(kinds()[command], text)
    before, given = given_in(line), []
    for name, default in options(kinds()[command]):
        option = f'--{name.replace("_", "-")}'
        shown = re.findall(rf'{option}[ ,](.*?)\((?:default|required)', text)
        if not shown:  # a word without an option
            continue
        told = [re.sub(r'--[\w-]+,?|\{.*?\}|\[.*\]|[A-Z:=]+', ' ', each) for each in shown]
        assert any(re.search('[a-z]{2,} .*[a-z]{2,}', each) for each in told), option
        if isinstance(default, int | float | str) and not isinstance(default, bool) and (
                option not in line and option != '--recipe'):  # without a name it is found
            given += [option, str(default)]
        choices = re.search(rf'{option} \{{([\w,-]+)\}}', text)
        if choices:
            for choice in choices[1].split(',')[-2:]:  # each takes a while
                with suppress(ConfigError):  # valid, but only with other options
                    assert choice in str(given_in(f'{line} {option} {choice}'))
            answer = refused(f'{line} {option} else', capsys)
            assert option in answer and all(each in answer for each in choices[1].split(','))
    assert given_in(f'{line} {shlex.join(given)}') == before


def test_commands_that_are_shown_are_valid():
    for command in [*SHOWN, *IN_THE_MAKEFILE]:
        if '--' in command or command in IN_THE_MAKEFILE:
            assert given_in(command), command
        else:  # a command is mentioned, what it needs is left out
            known = command.split(' bags')[0].strip()
            assert any(each.startswith(known) for each in kinds()), command


def test_help_comes_without_what_takes_long_to_import():
    for command, allowed in (('TAP_ROS', ()), ('TAP_ROS evaluate', ()),
                             ('TAP_ROS train predictor', ()), ('LINE planning', ('mujoco',))):
        line, *words = command.split()
        slow = {'torch', 'mujoco', 'rclpy', 'cv2', 'tensorboard'} - {*allowed}
        run = subprocess.run([sys.executable, '-c', (
            'import atexit, sys; from tap_ros.apps.cli import main; '
            'from tap_ros.__main__ import LINE as TAP_ROS; '
            'from experiments.__main__ import LINE; '
            f'atexit.register(lambda: print("slow:", {slow} & set(sys.modules))); '
            f'main({line}, sys.argv[1:] + ["--help"])'), *words], capture_output=True, text=True)
        assert run.returncode == 0 and run.stdout.splitlines()[-1] == 'slow: set()', command
