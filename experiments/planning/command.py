# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command line of Table 2: python -m tap_ros evaluate planning."""

from dataclasses import dataclass
from typing import Annotated, Literal

from sim_bridge.world.looks import DEFAULT_LOOK, LOOKS
from tap_ros.contract import step_budget
from tap_ros.engines.options import EngineOptions
from tap_ros.options import Flag, Folder, one_of, ShippedFile
from tap_ros.planning.mpc_config import PRESETS, SWITCHES
from tap_ros.planning.scenes import FIRST_SCENE, PLANNING_TASKS
from tap_ros.weights import FORWARD_MODEL
from tyro import conf

BUDGETS = f'{step_budget(2)} and {step_budget(3)}'  # of two and of three objects
DEFAULT_METHODS = ('nothing', 'direct', 'direct:twice', 'fix', 'genmin', 'genmin+progress',
                   'genmin+relative', 'shipped', 'oracle_order', 'true_subgoal', 'true_model')
# What the command paper calls the predictors that these methods stand for.
RUNS = {'fix': 'fix-wo-gan+skips', 'genmin': 'genmin-wo-gan+skips',
        'genmin+progress': 'genmin-wo-gan+progress+skips',
        'genmin+relative': 'genmin-wo-gan+relative+skips',
        'genmin+relative+rounds': 'genmin-wo-gan+relative+skips+rounds',
        'fix+rounds': 'fix-wo-gan+skips+rounds',
        'genmin+relative+scratch': 'genmin-wo-gan+relative+skips+scratch',
        'fix+scratch': 'fix-wo-gan+skips+scratch'}
TRAINED = 'runs/paper/small/{task}-bidirectional-{name}-warp-s0/predictor.safetensors'


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param tasks: what is planned.
    :param methods: nothing, direct, one_object, oracle_order, true_subgoal, true_model, shipped
        for the shipped predictor; fix, genmin (over time), genmin+progress and genmin+relative
        for those that the command paper trained with our network and without GAN, or the name of
        another one; with options behind colons: half, stalled, recursion<n>, rounds<n>,
        samples<n>, carried, true_maps, true_model, twice, more_search, paper (its search whatever
        --preset says), plain_cost, every<n>, steps<n>, for example genmin:half:carried.
    :param predictor: weights of predictors; {task} in FILE stands for the task; without it, what
        the command paper trained.
    :param look: of the world, see sim_bridge.world.looks; pictures are filled behind the robot as
        the weights' training was, by the looks' robot masks.
    :param scenes: how many.
    :param seed: of the first scene.
    :param switch: go on from a subgoal when it is reached; when nothing moves any more, too; or
        at its share of the budget as in the paper; for all methods, as the next three and
        step_budget.
    :param recursion: subgoals in a row.
    :param samples: subgoals to choose from, for predictors that draw.
    :param tracking: where object pixels come from.
    :param preset: settings of the planner.
    :param plan_samples: samples of an iteration of the search; 0: the preset's.
    :param plan_iterations: iterations of the search; 0: the preset's.
    :param replan_every: plan anew at every so many actions; 0: the preset's.
    :param forward_weights: of the forward model.
    :param device: of the networks: cpu or cuda.
    :param out: for planning.json, planning.md and the scenes in planning/; an interrupted
        evaluation goes on there.
    :param recordings: for MCAP files of the best, median and worst scene.
    :param no_films: leave out film strips and recordings.
    :param results_only: run nothing, make planning.json and planning.md again from the scenes.
    """

    tasks: tuple[Annotated[str, one_of(PLANNING_TASKS)], ...] = PLANNING_TASKS
    methods: Annotated[tuple[str, ...], conf.arg(metavar='METHOD [METHOD ...]')] = DEFAULT_METHODS
    predictor: Annotated[tuple[str, ...], conf.arg(
        metavar='NAME=FILE [NAME=FILE ...]', help_behavior_hint=f'(default: {TRAINED})')] = ()
    look: Annotated[str, one_of(LOOKS)] = DEFAULT_LOOK
    scenes: int = 100
    seed: int = FIRST_SCENE
    engine: EngineOptions = EngineOptions()
    switch: Annotated[str, one_of(SWITCHES)] = 'reached'
    recursion: int = 1
    samples: int = 1
    tracking: Literal['ground_truth', 'carried'] = 'ground_truth'
    preset: Annotated[str, one_of(PRESETS)] = 'default'
    plan_samples: int = 0
    plan_iterations: int = 0
    replan_every: int = 0
    step_budget: Annotated[int, conf.arg(
        help=f"control periods; 0: the paper's, {BUDGETS}.")] = 0
    forward_weights: ShippedFile = str(FORWARD_MODEL)
    device: str = 'cpu'
    out: Folder = 'docs/results'
    recordings: Folder = 'runs/planning'
    no_films: Flag = False
    results_only: Flag = False


def run(args):
    """Run what is missing; write the numbers, the page and the films."""
    from experiments.planning.evaluate import evaluate  # torch takes seconds, --help does without
    evaluate(args)
