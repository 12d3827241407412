# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros train forward`."""

from dataclasses import dataclass

from tap_ros.options import Folder, Topic
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
from tap_ros.recording.reading_options import Part
from tap_ros.training.command import RecipeOption, Recordings, run_training, with_recipe


@dataclass(frozen=True)
class Training(ForwardTrainingConfig):
    """How the forward model is trained."""

    recordings: Recordings
    out: Folder = 'runs/forward'
    image_topic: Topic = ''
    crop: Part = ''


@dataclass(frozen=True, kw_only=True)
class Options(RecipeOption):
    """Options of the command."""

    training: Training


def defaults(args: Options) -> Options:
    """Return what stands for the options that were left out: those of the recipe."""
    return with_recipe('forward', args)


def run(args: Options) -> None:
    """Train, and print where the weights are."""
    run_training('forward', args)
