# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of Table 2 and of stacking: python -m experiments planning."""

from dataclasses import dataclass
from typing import Annotated

from experiments.planning.methods import TASKS
from sim_bridge.world.looks import DEFAULT_LOOK, LOOKS
from tap_ros.base.engines import Engine
from tap_ros.base.options import Flag, Folder, one_of, ShippedFile
from tap_ros.base.plugins import names
from tap_ros.planning.mpc_config import PRESETS
from tap_ros.weights import FORWARD_MODEL, PLANNING_TASKS
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: what is pushed or stacked.
    :param methods: what is compared: direct, shipped, lowest_first, the names of predictors
        of the command paper, or your own; with options behind colons: half,
        recursion<n>, rounds<n>, samples<n>, tracked, true_model, twice, steps<n>. By
        default the usual ones of each task, stacking only with weights that are there.
    :param predictor: weights of predictors; {task} in FILE stands for the task; without it, what
        the command paper trained.
    :param look: of the world; pictures are filled behind the robot as
        the weights' training was, by the looks' robot masks.
    :param scenes: how many.
    :param seed: of the first scene; 0: the usual one, in which nothing was trained.
    :param preset: settings of the planner.
    :param solver: what searches the actions.
    :param forward_weights: of the forward model.
    :param device: of the networks: cpu or cuda.
    :param out: for planning.json, stacking.json and the scenes in planning/ and stacking/; an
        interrupted evaluation goes on there.
    :param no_films: leave out the pictures of scenes.
    :param results_only: run nothing, make the numbers again from the scenes.
    """

    tasks: tuple[Annotated[str, one_of(TASKS)], ...] = PLANNING_TASKS
    methods: Annotated[tuple[str, ...], conf.arg(metavar='METHOD [METHOD ...]')] = ()
    predictor: Annotated[tuple[str, ...], conf.arg(metavar='NAME=FILE [NAME=FILE ...]')] = ()
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
    scenes: int = 100
    seed: int = 0
    engine: Engine = Engine()
    preset: Annotated[str, one_of(PRESETS)] = 'default'
    solver: Annotated[str, one_of(names('tap_ros.solvers'))] = 'cem'
    forward_weights: ShippedFile = str(FORWARD_MODEL)
    device: str = 'cpu'
    out: Folder = 'runs/results'
    no_films: Flag = False
    results_only: Flag = False


def run(args):
    """Run what is missing; write the numbers and the films."""
    from experiments.planning.evaluate import evaluate  # torch takes seconds, --help does without
    evaluate(args)
