# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The options of commands that say how recordings are read."""

from dataclasses import dataclass
from typing import Annotated

from tap_ros.options import default_text
from tap_ros.recording.reading import Reading
from tyro import conf

Topics = conf.UseAppendAction[Annotated[tuple[str, ...], conf.arg(metavar='TOPIC')]]
Part = Annotated[str, conf.arg(metavar='PART', help_behavior_hint=default_text)]


@dataclass(frozen=True)
class ReadingOptions(Reading):
    """Which pictures of the recordings are used."""

    image_topic: Topics = ()
    crop: Part = ''

    def __post_init__(self) -> None:
        """Leave it to Reading, which is made of this, to refuse what cannot be read with."""
