# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a command line does: the words to options, the command, errors in one line.

A command is a dataclass of options and a function that takes them. The commands stand in
tap_ros/__main__.py and experiments/__main__.py.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
import os
import signal
import sys
from typing import Annotated, Any, NamedTuple, TypeAlias
import warnings

from tap_ros.base.contract import VERSION
from tap_ros.base.errors import TapError
from tap_ros.base.interrupts import leave_at_once
from tap_ros.base.options import parse
from tap_ros.base.text import escaped, meant
from tyro import conf

EXTRAS = {  # what only some commands need, and what pip calls it
    'google': 'google-crc32c protobuf', 'google_crc32c': 'google-crc32c protobuf',
    'h5py': 'h5py', 'pyarrow': 'pyarrow', 'ray': 'ray',
    'websockets': 'websockets'}


class Command(NamedTuple):
    """Options, a dataclass, and what is done with them."""

    options: Any
    run: Callable[[Any], Any]  # what it returns is the exit code, if it is an int
    defaults: Callable[[Any], Any] | None = None  # of what is left out, by what is said


# By word: one line of help, and what imports the command, or the commands of a second word.
Commands: TypeAlias = 'Mapping[str, tuple[str, Callable[[], Command] | Commands]]'


class CommandLine(NamedTuple):
    """What is called how."""

    prog: str
    summary: str
    commands: Commands


@dataclass(frozen=True)
class Unread:
    """Options of a command that was not asked for."""


def main(line: CommandLine, arguments: Sequence[str] | None = None) -> int:
    """
    Run one command.

    :param arguments: list of strings; by default those of the process.
    :return: exit code: 0, 1 after an error that was named or when nobody reads the output, 130
        when interrupted.
    :raises SystemExit: with code 2 for words that are no command or option, which are printed;
        with code 0 after --help.
    """
    code: int | SystemExit
    try:
        try:
            code = _main(line, sys.argv[1:] if arguments is None else list(arguments))
        except SystemExit as end:  # what --help prints is not written yet
            code = end
        if sys.stdout:
            sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError):  # who read it has seen enough: `... | head`
            print(f'error: {_about(error)}', file=sys.stderr)
        if sys.stdout:  # nothing is left to flush
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if isinstance(code, SystemExit):
        raise code
    return code


def _about(error: OSError) -> str:
    """Return cause and remedy in one line."""
    place = f'{escaped(error.filename)}: ' if error.filename else ''
    return (f'{place}{escaped(error.strerror or error)}; see whether the place is there, yours '
            'and not full')


def _main(line: CommandLine, arguments: Sequence[str]) -> int:
    """Run one command; a pipe that nobody reads is left to the caller."""
    if arguments == ['--version']:
        print(f'tap_ros {VERSION}')
        return 0
    warnings.formatwarning = lambda message, *_, **__: f'warning: {message}\n'
    try:
        run, options = read(line, arguments)
        if signal.getsignal(signal.SIGINT) is leave_at_once:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        code = run(options)
        return code if isinstance(code, int) else 0
    except TapError as error:
        message = escaped(error, 2000)
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        message = f'{error.name} is not installed; type `pip install {EXTRAS[error.name]}`'
    except BrokenPipeError:
        raise
    except OSError as error:
        message = _about(error)
    except KeyboardInterrupt as error:
        print('; '.join(['interrupted', *map(str, error.args)]), file=sys.stderr)
        # After one that left an exec(), as in making a dataclass, Python ends by SIGINT though it
        # was caught; the next exec() makes it forget that.
        exec('')
        return 130
    print(f'error: {message}', file=sys.stderr)
    return 1


def read(line: CommandLine, arguments: Sequence[str]) -> tuple[Callable[[Any], Any], Any]:
    """
    Find out which command is asked for.

    :param arguments: list of strings.
    :return: its function, and the options to call it with.
    :raises SystemExit: with code 2 for words that are no command or option, which are printed;
        with code 0 after --help, and after what prints shell completion.
    """
    words = list(arguments)
    _check(line.commands, words)
    completion = bool(words) and words[0].startswith('--tyro-')
    found: dict[Any, Command] = {}
    # What is completed is a name that a shell can look up, not three words.
    options = parse(_union(line.commands, None if completion else words, found), words,
                    line.prog.split()[-1] if completion else line.prog, line.summary)
    command = found[type(options)]
    if command.defaults:
        options = parse(command.options, words[2:], f'{line.prog} {words[0]} {words[1]}',
                        default=command.defaults(options))
    return command.run, options


def _check(commands: Commands, words: Sequence[str]) -> None:
    """Exit with code 2 where a word is no command or missing; say which is nearest, and all."""
    word = words[0].replace('_', '-') if words else '-'
    if word in commands:
        inner = commands[word][1]
        if not callable(inner):
            if not words[1:]:
                print(f'error: {word} needs a second word; valid: {", ".join(inner)}',
                      file=sys.stderr)
                raise SystemExit(2)
            _check(inner, words[1:])
    elif not word.startswith('-'):
        print(f'error: command {escaped(words[0], 60)!r} is unknown; {meant(word, commands)}'
              f'valid: {", ".join(commands)}', file=sys.stderr)
        raise SystemExit(2)


def _union(commands: Commands, words: Sequence[str] | None, found: dict[Any, Command]) -> Any:
    """
    Return the type of the options of commands, a union.

    :param words: what is said, of which the first one is a command; None: anything may be.
    :param found: gets the commands that may be asked for, by their options.
    """
    kinds = []
    for name, (summary, load) in commands.items():
        asked = words is None or words[:1] in ([name], [name.replace('-', '_')])
        kind: Any = Unread
        if not callable(load):
            kind = _union(load, words and words[1:] if asked else [], found)
        elif asked:
            try:
                command = load()
                kind, found[command.options] = command.options, command
            except ImportError:  # without ROS what there is can be completed
                if words is not None:
                    raise
        kinds.append(Annotated[kind, conf.subcommand(name, description=summary)])
    return reduce(or_, kinds)
