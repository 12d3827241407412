# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings that every training has, and how the commands `train ...` name them."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Annotated, Any

from tap_ros.errors import check_fields, ConfigError
from tap_ros.options import default_text, Folder
from tap_ros.recording.reading import ReadingOptions
from tap_ros.training.split import TEST_FRACTION
from tyro import conf

Recordings = Annotated[conf.Positional[tuple[str, ...]], conf.arg(
    metavar='BAG [BAG ...]', help_behavior_hint='(required)')]
# Settings that change where a run happens and what it shows, not what it learns.
FREE = ('recordings', 'marks', 'out', 'device', 'threads', 'log_every', 'save_every')
_RANGES: dict[str, tuple[float, float]] = {
    'test_fraction': (0, 0.9), 'threads': (0, math.inf), 'log_every': (1, math.inf),
    'save_every': (1, math.inf), 'steps': (1, math.inf), 'batch_size': (1, math.inf),
    'learning_rate': (0, 1), 'warmup': (0, math.inf), 'average_decay': (0, 0.99999)}


@dataclass(frozen=True)
class RunSettings:
    """
    Where a run happens and what it leaves.

    :param recordings: .mcap files, bag folders, or folders of these.
    :param out: the run's folder; if it holds a checkpoint, training goes on from there.
    :param test_fraction: share of episodes held out, by seed.
    :param held_out: recordings that are held out instead, among those to train on or beside them.
    :param seed: of the weights, batches and augmentation.
    :param device: where the networks are: 'auto', 'cpu' or 'cuda'.
    :param threads: of the CPU; 0: what OMP_NUM_THREADS says, or one. More are faster on cores that
        nothing else uses, and many times slower on others.
    :param log_every: steps between curve points.
    :param save_every: steps between checkpoints, scores and sample pictures.
    """

    recordings: tuple[str, ...]
    out: str
    test_fraction: float = TEST_FRACTION
    held_out: tuple[str, ...] = ()
    seed: int = 0
    device: str = 'auto'
    threads: int = 0
    log_every: int = 20
    save_every: int = 500


@dataclass(frozen=True)
class OptimizerSettings:
    """
    How the weights are moved.

    :param steps: length of the training, and of the cosine schedule of the learning rate.
    :param batch_size: episodes or windows a step; 64 in the paper.
    :param learning_rate: of Adam, at its highest. 1e-4 in the paper, for 200 epochs.
    :param warmup: steps over which the learning rate rises.
    :param gradient_clip: largest norm of the gradient; 0: any.
    :param average_decay: of the exponential moving average that is shipped; 0: none.
    """

    steps: int = 10000
    batch_size: int = 24
    learning_rate: float = 1e-3
    warmup: int = 100
    gradient_clip: float = 1.0
    average_decay: float = 0.999


def check_settings(config: Any, ranges: Mapping[str, tuple[float, float]]) -> None:
    """
    Raise ConfigError for settings of a training that are none of the choices, or out of range.

    :param config: a dataclass with the fields of RunSettings.
    :param ranges: see check_fields, beside those that all trainings share.
    """
    if not config.recordings:
        raise ConfigError('recordings: expected at least one .mcap file or bag folder')
    check_fields(config, {**_RANGES, **ranges})


@dataclass(frozen=True)
class RunOptions(RunSettings):
    """Where the run happens and what it leaves; by default in runs/predictor or runs/forward."""

    recordings: Recordings
    out: Folder = ''
    held_out: Annotated[tuple[str, ...], conf.arg(
        metavar='BAG [BAG ...]', help_behavior_hint='(default: none)')] = ()


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """
    What the options of all commands `train ...` begin with.

    :param recipe: name of a recipe (training/recipes.py); without it that of the task that the
        recordings name, else the one whose defaults are shown here.
    """

    recipe: Annotated[str, conf.arg(metavar='NAME', help_behavior_hint=default_text)] = ''
    run: RunOptions
    reading: ReadingOptions = ReadingOptions()
