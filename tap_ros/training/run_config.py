# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The settings that every training has."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Annotated

from tap_ros.base.errors import check_fields, ConfigError
from tap_ros.base.options import default_text, Folder
from tap_ros.images.robot_mask import RobotMask
from tap_ros.recording.reading import ReadingOptions
from tap_ros.training.split import Split, TEST_FRACTION
from tyro import conf

Name = Annotated[str, conf.arg(metavar='NAME', help_behavior_hint=default_text)]
Recordings = Annotated[conf.Positional[tuple[str, ...]], conf.arg(
    metavar='BAG [BAG ...]', help_behavior_hint='(required)')]
HeldOut = Annotated[tuple[str, ...], conf.arg(
    metavar='BAG [BAG ...]', help_behavior_hint='(default: none)')]
# Settings that change where a run happens and what it shows, not what it learns.
FREE = ('recordings', 'recipe', 'marks', 'out', 'device', 'threads', 'log_every', 'save_every')
_RANGES: dict[str, tuple[float, float]] = {
    'test_fraction': (0, 0.9), 'threads': (0, math.inf), 'log_every': (1, math.inf),
    'save_every': (1, math.inf), 'steps': (1, math.inf), 'batch_size': (1, math.inf),
    'learning_rate': (0, 1)}


@dataclass(frozen=True, kw_only=True)
class RunConfig(ReadingOptions):
    """
    The settings that every training has, and how recordings are read.

    :param recordings: .mcap files, bag folders, or folders of these.
    :param recipe: whose settings stand for those that are not given; without a name that of the
        task that the recordings name, else the one whose settings are shown here.
    :param out: the run's folder; if it holds a checkpoint, training goes on from there.
    :param test_fraction: share of the scenes or demonstrations that is held out, unmarked first.
    :param held_out: recordings that are held out instead, among those to train on or beside them,
        or demonstrations of one by their numbers from 0: bags/mine:7 or bags/mine:3,10-19.
    :param split: how the share is drawn: 'exact'; or 'crc32', as the shipped weights were, on
        average only, and marked or not.
    :param seed: of the weights, batches and augmentation.
    :param device: where the networks are: 'auto', 'cpu' or 'cuda'.
    :param threads: of the CPU; 0: what OMP_NUM_THREADS says, or one. More are faster on cores that
        nothing else uses, and many times slower on others.
    :param log_every: steps between curve points.
    :param save_every: steps between checkpoints, scores and sample pictures.
    :param steps: length of the training, and of the cosine schedule of the learning rate.
    :param batch_size: episodes or windows a step; 64 in the paper.
    :param learning_rate: of Adam, at its highest. 1e-4 in the paper, for 200 epochs.
    :param robot_mask: what the recordings' robot masks take out of pictures.
    """

    recordings: Recordings
    recipe: Name = ''
    out: Folder
    test_fraction: float = TEST_FRACTION
    held_out: HeldOut = ()
    split: Split = 'exact'
    seed: int = 0
    device: str = 'auto'
    threads: int = 0
    log_every: int = 20
    save_every: int = 500
    steps: int
    batch_size: int
    learning_rate: float
    robot_mask: RobotMask = 'none'

    def check(self, ranges: Mapping[str, tuple[float, float]] | None = None) -> None:
        """
        Raise ConfigError for settings that cannot be trained with.

        :param ranges: see check_fields, beside those that all trainings share.
        """
        if not self.recordings:
            raise ConfigError('recordings: expected at least one .mcap file or bag folder')
        check_fields(self, {**_RANGES, **(ranges or {})})
