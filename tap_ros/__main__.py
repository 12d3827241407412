# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Run `python -m tap_ros ...`.

A command is imported only when it is asked for: one needs no ROS, another no simulator.
"""

from collections.abc import Sequence
from importlib import import_module
import sys

from tap_ros.apps import cli
from tap_ros.apps.cli import Command, CommandLine


def _collect() -> Command:
    collect = import_module('sim_bridge.collect')  # nothing here depends on the simulator
    return Command(collect.Options, collect.run)


def _import_video() -> Command:
    from tap_ros.recording.formats.pictures import Options, run
    return Command(Options, run)


def _import_arrays() -> Command:
    from tap_ros.recording.formats.arrays import Options, run
    return Command(Options, run)


def _import_tfrecord() -> Command:
    from tap_ros.recording.formats.tfrecord import Options, run
    return Command(Options, run)


def _import_lerobot() -> Command:
    from tap_ros.recording.formats.lerobot import Options, run
    return Command(Options, run)


def _export_lerobot() -> Command:
    from tap_ros.recording.formats.lerobot_export import Options, run
    return Command(Options, run)


def _mark() -> Command:
    from tap_ros.apps.mark_command import Options, run
    return Command(Options, run)


def _label() -> Command:
    from tap_ros.apps.label_command import Options, run
    return Command(Options, run)


def _train_predictor() -> Command:
    from tap_ros.apps.train import defaults, run
    from tap_ros.training.predictor_config import TrainingConfig
    return Command(TrainingConfig, run, defaults)


def _train_forward() -> Command:
    from tap_ros.apps.train import defaults, run
    from tap_ros.training.forward_config import ForwardTrainingConfig
    return Command(ForwardTrainingConfig, run, defaults)


def _evaluate_prediction() -> Command:
    from tap_ros.apps.evaluate_prediction import Options, run
    return Command(Options, run)


def _evaluate_forward() -> Command:
    from tap_ros.apps.evaluate_forward import Options, run
    return Command(Options, run)


def _predict() -> Command:
    from tap_ros.apps.predict_command import Options, run
    return Command(Options, run)


def _call() -> Command:
    from tap_ros.apps.call_command import Options, run
    return Command(Options, run)


def _demo() -> Command:
    import_module('tap_ros.ros')  # without ROS it says so in a line
    from tap_ros.apps.demo.command import Options, run
    return Command(Options, run)


def _explore() -> Command:
    from tap_ros.apps.explorer.command import Options, run
    return Command(Options, run)


def _inspect() -> Command:
    from tap_ros.apps.inspect_files import Options, run
    return Command(Options, run)


LINE = CommandLine('python -m tap_ros', (
    'Collect recordings, train, evaluate, show. --version prints the version.'), {
    'collect': ('simulate the expert and record it', _collect),
    'import-video': ('import video files', _import_video),
    'import-arrays': ('import pictures of HDF5 files', _import_arrays),
    'import-tfrecord': ('import TFRecord files: RLDS data sets, BAIR', _import_tfrecord),
    'import-lerobot': ('import a LeRobot data set', _import_lerobot),
    'export-lerobot': ('export recordings as a LeRobot data set', _export_lerobot),
    'mark': ('mark the bottleneck in a few demonstrations, on a page in the browser', _mark),
    'label': ('from ten marks to labels in all demonstrations', _label),
    'train': ('train on recordings', {
        'predictor': ('train a subgoal predictor', _train_predictor),
        'forward': ("train the planner's forward model", _train_forward)}),
    'evaluate': ('score trained weights', {
        'prediction': ('score a predictor on recordings', _evaluate_prediction),
        'forward': ('score a forward model on recordings', _evaluate_forward)}),
    'predict': ('predict subgoals from picture files', _predict),
    'call': ('ask a running predictor node', _call),
    'demo': ('push objects via a subgoal, with real nodes', _demo),
    'explore': ('see and try all nodes on a page in the browser', _explore),
    'inspect': ('show what a recording or a weights file holds', _inspect)})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, as cli.main."""
    return cli.main(LINE, arguments)


if __name__ == '__main__':
    sys.exit(main())
