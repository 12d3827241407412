# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The settings of a training run of the forward model; `python -m tap_ros train forward`."""

from dataclasses import dataclass, fields
from functools import partial
import math

from tap_ros.errors import ConfigError
from tap_ros.recording.reading import Reading
from tap_ros.training.robot_mask import RobotMask
from tap_ros.training.settings import (
    check_settings,
    OptimizerSettings,
    RunSettings,
    TrainOptions,
)
from tap_ros.training.train import run_training, with_recipe


@dataclass(frozen=True)
class ForwardSettings(OptimizerSettings):
    """
    How the forward model is trained.

    :param horizon: control periods of the longest windows.
    :param grow: share of the steps over which windows grow from 2 periods to the horizon.
    :param pictures: pictures compared per window.
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
    :param projection: of the camera, K [R | t], 12 numbers row by row, from metres of the robot,
        z = 0 on the table, to pixels of the camera. It tells where the table is; without it the
        objects' recorded places do, or else the arm.
    :param initial_weights: file of a forward model to begin with instead of fresh weights; 'push':
        the shipped one. Its picture of the arm is not taken over.
    """

    steps: int = 5000
    batch_size: int = 16
    learning_rate: float = 2e-3
    average_decay: float = 0.995
    horizon: int = 8
    grow: float = 0.4
    pictures: int = 4
    motion_factor: float = 8.0
    still_weight: float = 2e-4
    object_weight: float = 5e-3
    width: int = 32
    features: int = 8
    augment: bool = True
    robot_mask: RobotMask = 'none'
    projection: tuple[float, ...] = ()
    initial_weights: str = ''


# Of the bases the last has its fields first.
@dataclass(frozen=True)
class ForwardTrainingConfig(ForwardSettings, Reading, RunSettings):
    """All that a training run of the forward model is made from."""

    def __post_init__(self) -> None:
        """Raise ConfigError for settings that cannot be trained with."""
        super().__post_init__()
        check_settings(self, {'grow': (0, 1), **dict.fromkeys(
            ('horizon', 'pictures', 'width', 'features'), (1, math.inf))})
        if len(self.projection) not in (0, 12) or self.projection and not self.projection[-1]:
            raise ConfigError('projection: expected 12 numbers, the last one not 0, got '
                              f'{len(self.projection)}')


# What settings were before they existed.
DEFAULTS = {field.name: field.default for field in fields(ForwardTrainingConfig)}
DEFAULTS['object_weight'] = 0.0


@dataclass(frozen=True, kw_only=True)
class Options(TrainOptions):
    """Options of the command `train forward`."""

    training: ForwardSettings = ForwardSettings()


defaults, run = partial(with_recipe, 'forward'), partial(run_training, 'forward')
