# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How recordings are read: which pictures of which camera, and where episodes are cut."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, TYPE_CHECKING

from tap_ros.base.errors import ConfigError
from tap_ros.base.options import check_different, default_text
from tyro import conf

if TYPE_CHECKING:
    from tap_ros.images.crop import Crop


@dataclass(frozen=True)
class Reading:
    """
    Which pictures of recordings are used.

    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
        Of several topics each gives episodes of its own.
    :param crop: the part of the pictures that is used: 'centre', the largest square in the middle,
        LEFT,TOP,SIDE, a square in pixels of the camera, or 'whole', which --size squeezes into a
        square. Without it pictures are used whole, and have to be square to be scaled.
    :param size: pixels a side that pictures are scaled to, such as 64; 0: not scaled.
    :param rate: pictures a second, about; 0: all of them.
    :param gap: s; where no marks tell episodes apart, a longer pause between two pictures does;
        0: never.
    :param episode_seconds: s; a bag alone, without marks and pauses, is cut into equal parts of
        at most this length; 0: never. Of several bags each is an episode.
    """

    image_topic: str | tuple[str, ...] = ''
    crop: str = ''
    size: int = 0
    rate: float = 0.0
    gap: float = 5.0
    episode_seconds: float = 20.0

    def __post_init__(self) -> None:
        """Refuse what cannot be read with."""
        if not isinstance(self.image_topic, str) and len(self.image_topic) < 2:
            object.__setattr__(self, 'image_topic', ''.join(self.image_topic))
        check_different('image_topic', self.cameras)
        if self.crop or self.size:
            self.cut  # noqa: B018  it says what is wrong
        for name in ('rate', 'gap', 'episode_seconds'):
            if not 0 <= getattr(self, name) <= 1e6:
                raise ConfigError(f'{name}: expected 0 to 1000000, got {getattr(self, name)}')

    @property
    def cameras(self) -> tuple[str, ...]:
        """The topics of cameras; of one '' is found."""
        topics = self.image_topic
        return (topics,) if isinstance(topics, str) else tuple(topics)

    @cached_property
    def cut(self) -> 'Crop':
        """What part of the pictures is used, as a Crop."""
        from tap_ros.images.crop import (
            Crop,  # here, as numpy takes a moment, and --help does without
        )
        return Crop(self.crop, self.size)


AS_RECORDED = Reading()
Topics = conf.UseAppendAction[Annotated[tuple[str, ...], conf.arg(metavar='TOPIC')]]
Part = Annotated[str, conf.arg(metavar='PART', help_behavior_hint=default_text)]


@dataclass(frozen=True)
class ReadingOptions(Reading):
    """Which pictures of the recordings are used."""

    image_topic: Topics = ()
    crop: Part = ''

    def __post_init__(self) -> None:
        """Leave it to Reading, which is made of this, to refuse what cannot be read with."""


def reading_of(settings: Reading) -> Reading:
    """Return the part of larger settings, a subclass, that says how recordings are read."""
    return Reading(**{field.name: getattr(settings, field.name) for field in fields(Reading)})
