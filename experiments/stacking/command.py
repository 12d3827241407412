# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of stacking via subgoals: python -m tap_ros evaluate stacking."""

from dataclasses import dataclass
from typing import Annotated

from experiments.planning.command import RUNS as PLANNED_RUNS
from sim_bridge.world.looks import DEFAULT_LOOK, LOOKS
from tap_ros.engines.options import EngineOptions
from tap_ros.options import Flag, Folder, one_of
from tyro import conf

FIRST_SCENE = 1_200_000  # seed; how pictures are read was tried out in others
STACKING_TASKS = ('stack3', 'stack2', 'pick_place')
DEFAULT_METHODS = (
    'nothing', 'direct', 'lowest_first', 'fix', 'genmin', 'genmin+progress', 'shipped',
    'shipped:recursion2', 'genmin+progress-r2:recursion2', 'true_subgoals', 'oracle_order',
    'true_places')
# What the command paper calls the predictors that these methods stand for.
RUNS = {**PLANNED_RUNS, 'genmin+progress-r2': f'{PLANNED_RUNS["genmin+progress"]}-r2'}
TRAINED = 'runs/paper/small/{task}-bidirectional-{name}-s0/predictor.safetensors'


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: what is built.
    :param methods: nothing; direct, the goal picture alone; lowest_first, likewise, what is lowest
        in it first; shipped for the subgoals of the shipped predictor; fix, genmin (over time) and
        genmin+progress for those that the command paper trained with our network and without GAN,
        with -r2 behind it if trained for recursion, or the name of another one; :recursion<n>
        behind a predictor for n subgoals in a row; true_subgoals, oracle_order, true_places. By
        default those whose weights are there.
    :param predictor: weights of predictors; {task} in FILE stands for the task; without it, what
        the command paper trained.
    :param look: of the world, see sim_bridge.world.looks.
    :param scenes: how many.
    :param seed: of the first scene.
    :param device: of the networks: cpu or cuda.
    :param out: for stacking.json, stacking.md and the scenes in stacking/; an interrupted
        evaluation goes on there.
    :param no_films: leave out the pictures of scenes.
    :param results_only: run nothing, make stacking.json and stacking.md again from the scenes.
    """

    tasks: tuple[Annotated[str, one_of(STACKING_TASKS)], ...] = STACKING_TASKS
    methods: Annotated[tuple[str, ...], conf.arg(metavar='METHOD [METHOD ...]')] = DEFAULT_METHODS
    predictor: Annotated[tuple[str, ...], conf.arg(
        metavar='NAME=FILE [NAME=FILE ...]', help_behavior_hint=f'(default: {TRAINED})')] = ()
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
    scenes: int = 100
    seed: int = FIRST_SCENE
    engine: EngineOptions = EngineOptions()
    device: str = 'cpu'
    out: Folder = 'docs/results'
    no_films: Flag = False
    results_only: Flag = False


def run(args):
    """Run what is missing; write the numbers, the page and the pictures."""
    from experiments.stacking.evaluate import evaluate  # torch takes seconds, --help does without
    evaluate(args)
