# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command line: collect recordings, train, evaluate, show, measure.

The options and the work of each command live beside what it is about, as add_arguments(parser) and
run(args); a module is imported only when asked for, so that one command needs no ROS and another
no simulator.
"""

import argparse
import importlib
import os
from pathlib import Path
import sys

from tap_ros.errors import ConfigError, TapError
from tap_ros.text import escaped

COMMANDS = {  # command: (one line of help, module or {what: module})
    'collect': ('simulate the expert and record it', 'sim_bridge.collect'),
    'import-bair': ('import the BAIR robot pushing data set', 'tap_ros.recording.bair'),
    'train': ('train on recordings', {
        'predictor': 'tap_ros.prediction.train_command',
        'forward': 'tap_ros.planning.train_command'}),
    'evaluate': ('score trained weights', {
        'prediction': 'tap_ros.evaluation.prediction',
        'forward': 'tap_ros.evaluation.forward',
        'planning': 'experiments.planning.command',
        'faults': 'experiments.faults.nodes.command'}),
    'paper': ("make the paper's prediction results again", 'experiments.paper.command'),
    'demo': ('push objects via a subgoal, with real nodes', 'tap_ros.nodes.demo'),
    'bench': ('measure speed; without a name, all of it', {
        'collect': 'experiments.bench.collect',
        'engine': 'experiments.bench.engine',
        'recording': 'experiments.bench.recording',
        'training': 'experiments.bench.training',
        'planning': 'experiments.bench.planning',
        'service': 'experiments.bench.nodes.service'}),
    'inspect': ('show what a recording or a weights file holds',
                'tap_ros.evaluation.inspect_files'),
}
TRAIN_DEFAULT = 'predictor'
EXTRAS = ('jinja2', 'pandas')  # what only experiments/ needs


def main(arguments=None):
    """
    Run one command.

    :param arguments: list of strings; by default those of the process.
    :return: exit code: 0, 1 after an error that was named, 130 when interrupted.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        args = build_parser(arguments).parse_args(arguments)
        return args.run(args) or 0
    except TapError as error:
        print(f'error: {escaped(error, 2000)}', file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        print(f'error: {error.name} is not installed; type `pip install -r '
              'requirements-experiments.txt` (`make build` has done it), or, with ROS 2 from apt, '
              f'`sudo apt install python3-{error.name}`', file=sys.stderr)
        return 1
    except BrokenPipeError:  # who read the output has seen enough, as in `... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing is left to flush
        return 1
    except OSError as error:
        place = f'{escaped(error.filename)}: ' if error.filename else ''
        print(f'error: {place}{escaped(error.strerror or error)}; see whether the place is there, '
              'yours and not full', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130


def build_parser(arguments):
    """Build the parser, with the options of just the command that is asked for."""
    parser = argparse.ArgumentParser(prog='python -m tap_ros', description=__doc__.split('\n')[1])
    commands = parser.add_subparsers(dest='command', required=True, metavar='command')
    for name, (summary, modules) in COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary)
        if arguments[:1] != [name]:
            continue
        if isinstance(modules, str):
            _use(command, modules)
        elif name == 'train':
            # An option rather than a word, as the predictor is what most want to train.
            command.add_argument(
                '--model', choices=list(modules), default=TRAIN_DEFAULT,
                help='what to train: the predictor, or the forward model of the planner (default: '
                     '%(default)s); --help shows its options. To predict from the start alone is '
                     '--mode forward of the predictor')
            known, _ = _quiet(modules).parse_known_args(arguments[1:])
            _use(command, modules[known.model])
        else:
            _add_words(command, name, modules, arguments)
    return parser


def _use(parser, module):
    """Give a parser the options and the work of a module."""
    if module.startswith('experiments.'):
        _find_experiments()
    module = importlib.import_module(module)
    module.add_arguments(parser)
    parser.set_defaults(run=module.run)


def _find_experiments():
    """Let experiments/ be imported, which is beside this package and not installed with it."""
    checkout = Path(__file__).resolve().parents[1]
    if not (checkout / 'experiments').is_dir():
        raise ConfigError('this command is not installed with the package; run it in a checkout '
                          'of its repository, after `make build`')
    if str(checkout) not in sys.path:
        sys.path.append(str(checkout))


def _quiet(modules):
    """Return a parser that only finds out what --model is."""
    # Without abbreviations, else --mode would be one of --model.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument('--model', choices=list(modules), default=TRAIN_DEFAULT)
    return parser


def _add_words(command, name, modules, arguments):
    """Add a second word, for example of 'evaluate planning'."""
    words = command.add_subparsers(dest='what', required=name != 'bench', metavar='what')
    for word, module in modules.items():
        chosen = words.add_parser(word, help=f'{name} {word}')
        if arguments[1:2] == [word]:
            _use(chosen, module)
    command.set_defaults(run=lambda args: _run_all(name, modules))


def _run_all(name, modules):
    """Run every variant of a command with its default options."""
    for word, module in modules.items():
        print(f'== {name} {word}', flush=True)
        parser = argparse.ArgumentParser()
        _use(parser, module)
        args = parser.parse_args([])
        args.run(args)
