# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The settings of a training run of the forward model; `python -m tap_ros train forward`."""

from dataclasses import dataclass, fields

from tap_ros.contract import ROBOT_MASKS
from tap_ros.errors import ConfigError
from tap_ros.options import Folder, Topic
from tap_ros.recording.reading import Reading
from tap_ros.recording.reading_options import Part
from tap_ros.training.command import RecipeOption, Recordings, run_training, with_recipe
from tap_ros.training.robot_mask import RobotMask
from tap_ros.training.split import TEST_FRACTION


@dataclass(frozen=True)
class ForwardRun:
    """
    Where a training run of the forward model happens.

    :param recordings: bag folders, folders of bag folders, or .mcap files.
    :param out: folder of the run; an interrupted run goes on there.
    """

    recordings: tuple[str, ...]
    out: str


# Of the bases the last has its fields first.
@dataclass(frozen=True)
class ForwardTrainingConfig(Reading, ForwardRun):
    """
    Settings of a training run of the forward model.

    :param steps: optimiser steps in all.
    :param batch_size: windows per step.
    :param horizon: control periods of the longest windows.
    :param grow: share of the steps over which windows grow from 2 periods to the horizon.
    :param pictures: pictures compared per window.
    :param learning_rate: peak of Adam.
    :param warmup: steps over which the learning rate rises.
    :param gradient_clip: largest norm of the gradient.
    :param average_decay: of the exponential moving average that is shipped.
    :param motion_factor: extra weight of pixels that changed since the window's first picture.
    :param still_weight: weight of the mean share of the crop that is said to move.
    :param object_weight: weight of the mean share of the picture that is said to be objects: with
        none, a table with grain counts as one, too.
    :param width: channels of the recurrence.
    :param features: channels that the recurrence reads.
    :param augment: mirror and recolour.
    :param robot_mask: what the recordings' robot masks take out of the pictures: 'none'; the arm
        with its shadow ('arm'); the hand, too ('all'). What was seen there free last takes its
        place in the picture that is looked at; no error counts there.
    :param test_fraction: share of episodes held out, by seed.
    :param seed: of the weights, windows and augmentation.
    :param device: where the model is: 'auto', 'cpu' or 'cuda'.
    :param threads: of the CPU; 0: as many as there are.
    :param log_every: steps between curve points.
    :param save_every: steps between checkpoints, scores and sample pictures.
    """

    steps: int = 5000
    batch_size: int = 16
    horizon: int = 8
    grow: float = 0.4
    pictures: int = 4
    learning_rate: float = 2e-3
    warmup: int = 100
    gradient_clip: float = 1.0
    average_decay: float = 0.995
    motion_factor: float = 8.0
    still_weight: float = 2e-4
    object_weight: float = 5e-3
    width: int = 32
    features: int = 8
    augment: bool = True
    robot_mask: RobotMask = 'none'
    test_fraction: float = TEST_FRACTION
    seed: int = 0
    device: str = 'auto'
    threads: int = 0
    log_every: int = 20
    save_every: int = 500

    def __post_init__(self) -> None:
        """Refuse settings that cannot be trained with."""
        super().__post_init__()
        if self.robot_mask not in ROBOT_MASKS:
            raise ConfigError(f'robot_mask: expected one of {", ".join(ROBOT_MASKS)}, '
                              f'got {self.robot_mask!r}')
        for name in ('steps', 'batch_size', 'horizon', 'pictures', 'width', 'features',
                     'log_every', 'save_every'):
            if getattr(self, name) < 1:
                raise ConfigError(f'{name}: expected at least 1, got {getattr(self, name)}')
        for name, low, high in (('grow', 0, 1), ('test_fraction', 0, 0.9),
                                ('average_decay', 0, 0.99999), ('learning_rate', 0, 1)):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f'{name}: expected {low}..{high}, got {getattr(self, name)}')


# What settings were before they existed.
DEFAULTS = {field.name: field.default for field in fields(ForwardTrainingConfig)}
DEFAULTS['object_weight'] = 0.0


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
