# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of predictor training: one option for each field of TrainingConfig."""

import argparse
from dataclasses import fields, MISSING
import re

from tap_ros.learning.parallel import local_rank
from tap_ros.prediction.methods import MODES
from tap_ros.prediction.training import train
from tap_ros.prediction.training_config import (
    GOAL_PICTURES,
    PARTS,
    POSTERIORS,
    PRECISIONS,
    TrainingConfig,
)

_CHOICES = {'mode': MODES, 'posterior': POSTERIORS, 'goal_picture': GOAL_PICTURES,
            'precision': PRECISIONS}


def add_arguments(parser):
    """
    Add the options of TrainingConfig to an argument parser.

    :param parser: argparse parser, or group of one.
    """
    for field in fields(TrainingConfig):
        option = '--' + field.name.replace('_', '-')
        about = _help(field.name)
        if field.name == 'recordings':
            parser.add_argument(option, nargs='+', required=True, metavar='BAG', help=about)
        elif field.default is MISSING:
            parser.add_argument(option, required=True, metavar='FOLDER', help=about)
        elif isinstance(field.default, bool):
            parser.add_argument(option, action=argparse.BooleanOptionalAction,
                                default=field.default, help=about)
        else:
            parser.add_argument(option, type=type(field.default), default=field.default,
                                choices=_CHOICES.get(field.name),
                                help=f'{about} (default: %(default)s)')


def run(args):
    """
    Train as the command line says, and print where the weights are.

    :param args: parsed arguments, of a parser that add_arguments was called with.
    :return: exit status.
    """
    values = {field.name: getattr(args, field.name) for field in fields(TrainingConfig)}
    values['recordings'] = tuple(values['recordings'])
    weights = train(TrainingConfig(**values))
    if not local_rank():
        print(weights)
    return 0


def _help(name):
    """Find a field's line in the docstring of its part of TrainingConfig, its one description."""
    described = '\n'.join(part.__doc__ for part in PARTS)
    found = re.search(rf':param {name}: (.*?)(?=\n\s*:param|\n\s*\n|\n\s*\Z)', described, re.S)
    return ' '.join(found[1].split()).replace('%', '%%')
