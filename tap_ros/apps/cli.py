# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command line: collect recordings, train, evaluate, show.

A command is a module with Options, a dataclass, and run(options), beside what it is about; it is
imported only when asked for, so that one command needs no ROS and another no simulator.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
import importlib
from operator import or_
import os
import signal
import sys
from typing import Annotated, Any, NamedTuple, TypeAlias
import warnings

from tap_ros.base.errors import TapError
from tap_ros.base.interrupts import leave_at_once
from tap_ros.base.options import parse
from tap_ros.base.text import escaped
from tyro import conf

# Of a command: the name of its module, MODULE:FUNCTION where that is of several commands, or
# {word: (one line of help, the same)}.
Module: TypeAlias = 'str | dict[str, tuple[str, Module]]'
Run: TypeAlias = Callable[[Any], Any]  # what it returns is the exit code, if it is an int

COMMANDS: dict[str, tuple[str, Module]] = {
    'collect': ('simulate the expert and record it', 'sim_bridge.collect'),
    'import-video': ('import video files', 'tap_ros.recording.formats.pictures'),
    'import-arrays': ('import pictures of HDF5 files',
                      'tap_ros.recording.formats.arrays'),
    'import-tfrecord': ('import TFRecord files: RLDS data sets, BAIR',
                        'tap_ros.recording.formats.tfrecord'),
    'import-lerobot': ('import a LeRobot data set', 'tap_ros.recording.formats.lerobot'),
    'export-lerobot': ('export recordings as a LeRobot data set',
                       'tap_ros.recording.formats.lerobot_export'),
    'mark': ('mark the bottleneck in a few demonstrations, on a page in the browser',
             'tap_ros.apps.mark_command'),
    'label': ('from ten marks to labels in all demonstrations', 'tap_ros.apps.label_command'),
    'train': ('train on recordings', {
        'predictor': ('train a subgoal predictor', 'tap_ros.apps.train:predictor'),
        'forward': ("train the planner's forward model", 'tap_ros.apps.train:forward'),
    }),
    'evaluate': ('score trained weights', {
        'prediction': ('score a predictor on recordings', 'tap_ros.apps.evaluate_prediction'),
        'forward': ('score a forward model on recordings', 'tap_ros.apps.evaluate_forward'),
    }),
    'predict': ('predict subgoals from picture files', 'tap_ros.apps.predict_command'),
    'call': ('ask a running predictor node', 'tap_ros.apps.call_command'),
    'demo': ('push objects via a subgoal, with real nodes', 'tap_ros.apps.demo.command'),
    'explore': ('see and try all nodes on a page in the browser',
                'tap_ros.apps.explorer.command'),
    'inspect': ('show what a recording or a weights file holds',
                'tap_ros.apps.inspect_files'),
}
EXTRAS = {  # what only some commands need, and what pip calls it
    'google': 'google-crc32c protobuf', 'google_crc32c': 'google-crc32c protobuf',
    'h5py': 'h5py', 'pyarrow': 'pyarrow', 'ray': 'ray',
    'websockets': 'websockets'}


class CommandLine(NamedTuple):
    """What is called how; commands as in COMMANDS."""

    prog: str
    summary: str
    commands: Mapping[str, tuple[str, Module]]


TAP_ROS = CommandLine('python -m tap_ros', (__doc__ or '').split('\n')[1], COMMANDS)


@dataclass(frozen=True)
class Unread:
    """Options of a command that was not asked for."""


def main(arguments: Sequence[str] | None = None, line: CommandLine = TAP_ROS) -> int:
    """
    Run one command.

    :param arguments: list of strings; by default those of the process.
    :param line: CommandLine that they are of.
    :return: exit code: 0, 1 after an error that was named, 130 when interrupted.
    :raises SystemExit: as options.parse, for words that are no command or option and for --help.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    warnings.formatwarning = lambda message, *_, **__: f'warning: {message}\n'
    try:
        run, options = read(arguments, line)
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
    except BrokenPipeError:  # who read the output has seen enough, as in `... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing is left to flush
        return 1
    except OSError as error:
        place = f'{escaped(error.filename)}: ' if error.filename else ''
        message = (f'{place}{escaped(error.strerror or error)}; see whether the place is there, '
                   'yours and not full')
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    print(f'error: {message}', file=sys.stderr)
    return 1


def read(arguments: Sequence[str], line: CommandLine = TAP_ROS) -> tuple[Run, Any]:
    """
    Find out which command is asked for.

    :param arguments: list of strings; line: as in main.
    :return: its function, and the options to call it with.
    :raises SystemExit: as options.parse.
    """
    words = list(arguments)
    completion = bool(words) and words[0].startswith('--tyro-')
    runs: dict[Any, Run] = {}
    # What is completed is a name that a shell can look up, not three words.
    options = parse(_union(line.commands, None if completion else words, runs), words,
                    line.prog.split()[-1] if completion else line.prog, line.summary)
    run = runs[type(options)]
    again = getattr(sys.modules[run.__module__], 'defaults', None)
    if again:  # what is left out depends on what was said
        options = parse(type(options), words[2:], f'{line.prog} {words[0]} {words[1]}',
                        default=again(options))
    return run, options


def _union(commands: Mapping[str, tuple[str, Module]], words: Sequence[str] | None,
           runs: dict[Any, Run]) -> Any:
    """
    Return the type of the options of commands, a union.

    :param words: what is said, of which the first one is a command; None: anything may be.
    :param runs: gets the function for the options.
    """
    kinds = []
    for name, (summary, module) in commands.items():
        asked = words is None or words[:1] in ([name], [name.replace('-', '_')])
        if isinstance(module, dict):
            kind = _union(module, words and words[1:] if asked else [], runs)
        else:
            kind = _load(module, runs, needed=words is not None) if asked else Unread
        kinds.append(Annotated[kind, conf.subcommand(name, description=summary)])
    return reduce(or_, kinds)


def _load(name: str, runs: dict[Any, Run], needed: bool = True) -> Any:
    """Import a module of COMMANDS; return the type of its options: Options, or as FUNCTION."""
    place, _, word = name.partition(':')
    try:
        module = importlib.import_module(place)
    except ImportError:
        if needed:
            raise
        return Unread  # without ROS it completes what there is
    kind = getattr(module, word.title() or 'Options')
    runs[kind] = getattr(module, word or 'run')
    return kind
