# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros train --model forward`."""

from dataclasses import dataclass
import json
from pathlib import Path
from typing import Annotated

from tap_ros.options import Bags, default_text, Folder, Topic
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
from tap_ros.recording.reading_options import Part
from tap_ros.training.model_option import ModelOption
from tyro import conf


@dataclass(frozen=True)
class Training(ForwardTrainingConfig):
    """How the forward model is trained."""

    recordings: Bags
    out: Folder = 'runs/forward_model'
    image_topic: Topic = ''
    crop: Part = ''


@dataclass(frozen=True, kw_only=True)
class Options(ModelOption):
    """
    Options of the command.

    :param stop_at: stop and save at this step; the next call goes on.
    """

    stop_at: Annotated[int | None, conf.arg(
        metavar='STEP', help_behavior_hint=default_text)] = None
    training: Training


def run(args: Options) -> None:
    """Train, and print where the weights are and how good."""
    from tap_ros.planning.forward_training import train  # torch takes seconds, --help does without
    path = train(args.training, stop_at=args.stop_at)
    scores = json.loads((Path(args.training.out) / 'scores.json').read_text())
    print(json.dumps(scores, indent=2))
    print(f'weights: {path}')
