# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run `python -m experiments ...`: what makes results, benchmarks and shipped weights again."""

from functools import partial
import sys

from tap_ros.apps.cli import Command, CommandLine, EXTRAS, main


def _paper():
    from experiments.paper.command import Options, run
    return Command(Options, run)


def _planning():
    from experiments.planning.command import Options, run
    return Command(Options, run)


def _worlds():
    from experiments.worlds.command import Options, run
    return Command(Options, run)


def _worlds_loop():
    from experiments.worlds.loop import Options, run
    return Command(Options, run)


def _labels():
    from experiments.labels import Options, run
    return Command(Options, run)


def _real():
    from experiments.real import Options, run
    return Command(Options, run)


def _few():
    from experiments.few import Options, run
    return Command(Options, run)


def _fullsize():
    from experiments.fullsize import Options, run
    return Command(Options, run)


def _tracking():
    from experiments.tracking import Options, run
    return Command(Options, run)


def _weights():
    from experiments.weights.command import Options, run
    return Command(Options, run)


def _bench(name):
    def load():
        from experiments.bench import everything
        return Command(everything.module(name).Options, partial(everything.measure, name))
    return load


def _bench_all():
    from experiments.bench.everything import Options, run
    return Command(Options, run)


LINE = CommandLine('python -m experiments', 'Make results, benchmarks and weights again.', {
    'paper': ("make the paper's prediction results again", _paper),
    'planning': ('push or stack objects and score where they end (Table 2)', _planning),
    'worlds': ("collect other simulators' demonstrations and score who finds their bottlenecks",
               _worlds),
    'worlds-loop': ("push in another simulator's scenes, by models trained there", _worlds_loop),
    'labels': ('score labels that a few marks give all demonstrations', _labels),
    'real': ('score predictors that a few marks of real demonstrations make', _real),
    'few': ('score what predictors learn from few demonstrations, simulated and real', _few),
    'fullsize': ("score how sharp subgoals are at the camera's resolution", _fullsize),
    'tracking': ('score the tracker on simulated scenes and real films', _tracking),
    'weights': ('make the shipped predictors again', _weights),
    'bench': ('measure speed', {
        'collect': ('speed of collecting', _bench('collect')),
        'recording': ('speed of reading recordings', _bench('recording')),
        'growth': ('memory and time of large recordings', _bench('growth')),
        'training': ('speed of training the predictor', _bench('training')),
        'planning': ('time of a plan', _bench('planning')),
        'service': ('time of an answer of the predictor node', _bench('service')),
        'start': ('time until all nodes are ready', _bench('start')),
        'busy': ('the same beside busy processes', _bench('busy')),
        'all': ('one after the other, what is not measured yet', _bench_all)})})

if __name__ == '__main__':
    EXTRAS['pandas'] = 'pandas'
    sys.exit(main(LINE))
