# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The settings of a training of the forward model, and recipes of them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from tap_ros.base.errors import ConfigError
from tap_ros.base.options import Folder
from tap_ros.images.robot_mask import RobotMask
from tap_ros.training.run_config import RunConfig


@dataclass(frozen=True, kw_only=True)
class ForwardTrainingConfig(RunConfig):
    """
    All that a training of the forward model is made from; the defaults are the shipped one's.

    :param grow: share of the steps over which windows grow from 2 periods to their full length.
    :param robot_mask: what the recordings' robot masks take out of the pictures: 'none'; the arm
        with its shadow ('arm'); the hand, too ('all'). What was seen there free last takes its
        place in the picture that is looked at; no error counts there.
    :param projection: of the camera, K [R | t], 12 numbers row by row, from metres of the robot,
        z = 0 on the table, to pixels of the camera. It tells where the table is; without it the
        objects' recorded places do, or else the arm.
    :param initial_weights: file of a forward model to begin with instead of fresh weights; 'push':
        the shipped one. Its picture of the arm is not taken over.
    """

    out: Folder = 'runs/forward'
    steps: int = 5000
    batch_size: int = 16
    learning_rate: float = 2e-3
    grow: float = 0.4
    robot_mask: RobotMask = 'none'
    projection: tuple[float, ...] = ()
    initial_weights: str = ''

    def check(self, ranges: Mapping[str, tuple[float, float]] | None = None) -> None:
        """Raise ConfigError for settings that cannot be trained with."""
        super().check({'grow': (0, 1), **(ranges or {})})
        if len(self.projection) not in (0, 12) or self.projection and not self.projection[-1]:
            raise ConfigError('projection: expected 12 numbers, the last one not 0, got '
                              f'{len(self.projection)}')


_PUSH = ForwardTrainingConfig(recordings=())
RECIPES = {'push': _PUSH,  # what stands for all recordings
           'debug': replace(_PUSH, steps=10, batch_size=4, test_fraction=0.3, threads=1)}
