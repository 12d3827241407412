# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros weights`: make the shipped predictors again."""

from dataclasses import dataclass
from pathlib import Path
import shlex
import subprocess
import sys
from typing import Annotated

from experiments.weights.card import ship
from experiments.weights.recipes import RECIPES
from tap_ros.options import Flag, Folder, one_of


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param only: names of weights; none: all.
    :param list: print the commands; do nothing.
    :param threads: of the CPU, for training; 0: as many as there are.
    :param bags: folder of recordings.
    :param runs: folder of trainings; those interrupted go on.
    :param out: folder for weights, cards and pictures.
    """

    only: tuple[Annotated[str, one_of(RECIPES)], ...] = ()
    list: Flag = False
    threads: int = 1
    bags: Folder = 'bags'
    runs: Folder = 'runs/weights'
    out: Folder = 'runs/weights/shipped'


def run(args):
    """
    Collect, train and write the card of each, one after the other.

    :param args: Options.
    :return: exit status: 0, or that of the step that failed.
    """
    for name in args.only or RECIPES:
        recipe = RECIPES[name]
        for words in recipe.commands(args.bags, args.runs):
            if words[0] == 'train':
                words = [*words, '--threads', str(args.threads)]
            print(shlex.join(['python', '-m', 'tap_ros', *words]), flush=True)
            if not args.list:
                status = subprocess.run([sys.executable, '-m', 'tap_ros', *words]).returncode
                if status:
                    return status
        if not args.list:
            Path(args.out).mkdir(parents=True, exist_ok=True)
            print(ship(recipe, args.bags, args.runs, args.out), flush=True)
    return 0
