# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run `python -m experiments ...`: what makes results, benchmarks and shipped weights again."""

import sys

from tap_ros.apps.cli import CommandLine, EXTRAS, main

LINE = CommandLine('python -m experiments', 'Make results, benchmarks and weights again.', {
    'paper': ("make the paper's prediction results again", 'experiments.paper.command'),
    'planning': ('push or stack objects and score where they end (Table 2)',
                 'experiments.planning.command'),
    'worlds': ("collect other simulators' demonstrations and score who finds their bottlenecks",
               'experiments.worlds.command'),
    'worlds-loop': ("push in another simulator's scenes, by models trained there",
                    'experiments.worlds.loop'),
    'labels': ('score labels that a few marks give all demonstrations', 'experiments.labels'),
    'real': ('score predictors that a few marks of real demonstrations make',
             'experiments.real'),
    'few': ('score what predictors learn from few demonstrations, simulated and real',
            'experiments.few'),
    'fullsize': ("score how sharp subgoals are at the camera's resolution",
                 'experiments.fullsize'),
    'tracking': ('score the tracker on simulated scenes and real films', 'experiments.tracking'),
    'weights': ('make the shipped predictors again', 'experiments.weights.command'),
    'bench': ('measure speed', {
        'collect': ('speed of collecting', 'experiments.bench.collect'),
        'recording': ('speed of reading recordings', 'experiments.bench.recording'),
        'training': ('speed of training the predictor', 'experiments.bench.training'),
        'planning': ('time of a plan', 'experiments.bench.planning'),
        'service': ('time of an answer of the predictor node', 'experiments.bench.nodes.service'),
        'all': ('one after the other, into a file', 'experiments.bench.everything'),
    }),
})

if __name__ == '__main__':
    EXTRAS['pandas'] = 'pandas'
    sys.exit(main(line=LINE))
