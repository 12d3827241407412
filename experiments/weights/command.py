# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m experiments weights`: make the shipped predictors by their recipes."""

from dataclasses import dataclass
from pathlib import Path
import shlex
from typing import Annotated

from sim_bridge.collect import collect, CollectConfig
from tap_ros.apps.train import train
from tap_ros.base.options import Flag, Folder, one_of

FRESH_SEED, FRESH_EPISODES = 900_000, 100  # of the scenes that weights are scored in
# Of each recipe: the task, and by the names of their folders what is recorded to train on, options
# of `collect` beside the task.
SHIPPED = {
    'push2': ('push2', {'push2': {'episodes': 2000},
                        'push2_random': {'episodes': 3500, 'appearance': 'random'}}),
    'order2': ('order2', {'order2': {'episodes': 700}}),
    'order3': ('order3', {'order3': {'episodes': 700}}),
    'push3': ('push3', {'push3': {'episodes': 600}}),
    'stack2': ('stack2', {'stack2': {'episodes': 1000}}),
    'stack3': ('stack3', {'stack3': {'episodes': 1000}}),
    'grasp': ('grasp', {'grasp': {'episodes': 3000},
                        'grasp_more': {'episodes': 3000, 'seed': 100_000}}),
    'grasp_forward': ('grasp', {'grasp': {'episodes': 3000}}),
    'pick_place': ('pick_place', {'pick_place': {'episodes': 3000},
                                  'pick_place_more': {'episodes': 4000, 'seed': 100_000},
                                  'pick_place_most': {'episodes': 7000, 'seed': 200_000}}),
    'pick_place_vae': ('pick_place', {'pick_place': {'episodes': 3000}})}


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param only: names of weights; none: all.
    :param list: print the commands; do nothing.
    :param threads: of the CPU, for training; 0: as many as there are.
    :param bags: folder of recordings, of which some are those of the command paper, too.
    :param runs: folder of trainings; those interrupted go on.
    :param out: folder for weights, cards and pictures.
    """

    only: tuple[Annotated[str, one_of(SHIPPED)], ...] = ()
    list: Flag = False
    threads: int = 1
    bags: Folder = 'bags/paper'
    runs: Folder = 'runs/weights'
    out: Folder = 'runs/weights/shipped'


def collections(name, bags):
    """Return {folder: options of `collect`} of a recipe, the fresh scenes to score in last."""
    task, recordings = SHIPPED[name]
    found = {**recordings, f'fresh_{task}': {'episodes': FRESH_EPISODES, 'seed': FRESH_SEED}}
    return {str(Path(bags, folder)): {'task': task, **options}
            for folder, options in found.items()}


def commands(name, bags='bags', runs='runs/weights'):
    """Return the command line of each step: those that collect, fresh scenes, the training."""
    found = collections(name, bags)
    lines = [['collect', *(word for option, value in options.items()
                           for word in (f'--{option.replace("_", "-")}', str(value))),
              '--out', folder] for folder, options in found.items()]
    lines.append(['train', 'predictor', *list(found)[:-1], '--recipe', name,
                  '--split', 'crc32', '--out', str(Path(runs, name))])
    return [shlex.join(['python', '-m', 'tap_ros', *words]) for words in lines]


def run(args):
    """Collect, train and write the card of each, one after the other."""
    for name in args.only or SHIPPED:
        print('\n'.join(commands(name, args.bags, args.runs)), flush=True)
        if args.list:
            continue
        from experiments.weights.card import ship  # with torch, which a list does not need

        found = collections(name, args.bags)
        for folder, options in found.items():
            collect(folder, CollectConfig(**options))
        *recordings, fresh = found
        run_folder = Path(args.runs, name)
        train(recordings, run_folder, recipe=name, split='crc32', threads=args.threads)
        Path(args.out).mkdir(parents=True, exist_ok=True)
        print(ship(name, SHIPPED[name][0], run_folder, fresh, args.out,
                   commands(name)), flush=True)
