# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros train predictor`: options are the parts of TrainingConfig."""

from dataclasses import dataclass

from tap_ros.options import Folder
from tap_ros.prediction.training_config import (
    DataSettings,
    NetworkSettings,
    ObjectiveSettings,
    OptimizerSettings,
    RunSettings,
)
from tap_ros.recording.reading_options import ReadingOptions
from tap_ros.training.command import RecipeOption, Recordings, run_training, with_recipe


@dataclass(frozen=True)
class RunOptions(RunSettings):
    """Where the run happens and what it leaves."""

    recordings: Recordings
    out: Folder = 'runs/predictor'


@dataclass(frozen=True, kw_only=True)
class Options(RecipeOption):
    """Options of the command."""

    run: RunOptions
    reading: ReadingOptions = ReadingOptions()
    objective: ObjectiveSettings = ObjectiveSettings()
    data: DataSettings = DataSettings()
    network: NetworkSettings = NetworkSettings()
    optimizer: OptimizerSettings = OptimizerSettings()


def defaults(args: Options) -> Options:
    """Return what stands for the options that were left out: those of the recipe."""
    return with_recipe('predictor', args)


def run(args: Options) -> None:
    """Train as the command line says, and print where the weights are."""
    run_training('predictor', args)
