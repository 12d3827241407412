# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of the forward model's training: python -m tap_ros train --model forward."""

from dataclasses import fields
import json
from pathlib import Path

from tap_ros.planning.forward_training import ForwardTrainingConfig, train

_HELP = {
    'steps': 'optimiser steps in all', 'batch_size': 'windows per step',
    'horizon': 'control periods of the longest windows', 'learning_rate': 'peak of Adam',
    'width': 'channels of the recurrence', 'seed': 'of weights, windows and augmentation',
    'device': "'auto', 'cpu' or 'cuda'", 'threads': 'of the CPU; 0: as many as there are',
    'test_fraction': 'share of the episodes held out', 'save_every': 'steps between checkpoints',
    'motion_factor': 'extra weight of pixels that changed'}


def add_arguments(parser):
    """Add the options of the forward model's training to a parser."""
    parser.add_argument('--recordings', nargs='+', required=True, metavar='BAG',
                        help='bag folders, folders of bag folders, or .mcap files')
    parser.add_argument('--out', default='runs/forward_model',
                        help='folder; an interrupted run goes on there (default: %(default)s)')
    parser.add_argument('--stop-at', type=int, metavar='STEP', help='stop and save at this step')
    for field in fields(ForwardTrainingConfig):
        if field.name in _HELP:
            parser.add_argument(
                '--' + field.name.replace('_', '-'), type=type(field.default),
                default=field.default, help=_HELP[field.name] + ' (default: %(default)s)')


def run(args):
    """Train, and print where the weights are and how good."""
    values = {name: getattr(args, name) for name in _HELP}
    config = ForwardTrainingConfig(recordings=tuple(args.recordings), out=args.out, **values)
    path = train(config, stop_at=args.stop_at)
    print(json.dumps(json.loads((Path(config.out) / 'scores.json').read_text()), indent=2))
    print(f'weights: {path}')
