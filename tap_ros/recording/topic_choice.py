# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which topics of a recording are read.

By what is needed: by type, name and namespace, by the number of messages and, where several would
do, by what is in them. Only where two cameras are left is somebody asked.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any
import warnings

import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS
from tap_ros.base.errors import ImageError, RecordingError
from tap_ros.base.text import escaped, listing
from tap_ros.messages.images import decode_image
from tap_ros.messages.joints import decode_positions, PLACE
from tap_ros.messages.topics import BY_COLUMNS, IMAGE, JOINT_STATES, Topic, TOPICS
from tap_ros.recording.damage import describe
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.foreign import explain, open_file
from tap_ros.recording.mcap_file import Channel
from tap_ros.recording.messages import check_schema, decode
from tap_ros.robots.arm import find_joints, known_arms

_LOOKED_AT = 5  # messages, as the first may be damaged
_FEW = 20  # of a picture topic are so many times fewer than of a camera


def list_paths(paths: Sequence[str | Path]) -> str:
    """Name the first of several files and how many more there are."""
    return str(paths[0]) + (f' and {len(paths) - 1} more' if len(paths) > 1 else '')


def find_topics(files: Sequence[Path], image_topic: str = '') -> dict[str, str]:
    """
    Choose the topics of a bag that are read.

    :param files: of the bag.
    :param image_topic: the camera's topic; by default it is found.
    :return: dict from topics to names of columns, Topic.becomes; what is lacking is left out.
    :raises RecordingError: without a camera, when several would do, and for messages that cannot
        be read.
    """
    bag = _Bag(files)
    camera = bag.camera(image_topic)
    found = {camera: IMAGE.becomes} | {
        topic: name for name, one in BY_COLUMNS.items() if one is not IMAGE
        for topic in bag.beside(one, camera)}
    for channel in bag.every.values():
        if channel.topic not in found or channel.type_name not in bag.types(channel.topic):
            continue
        source = f'{bag.source}: topic {escaped(channel.topic)}'
        if channel.encoding != 'cdr':
            raise RecordingError(
                f'{source}: encoded as {channel.encoding[:40]!r}; only cdr can be read')
        if channel.schema_encoding == 'ros2msg':
            try:
                check_schema(channel.type_name, channel.schema)
            except RecordingError as error:
                raise RecordingError(f'{source}: {error}') from error
    return found


class _Bag:
    """The topics of a bag."""

    def __init__(self, files: Sequence[Path]) -> None:
        self.files, self.source = files, list_paths(files)
        self.channels: dict[str, Channel] = {}  # of several types, the one that fits the name
        self.every: dict[tuple[str, str], Channel] = {}  # by topic and type
        self.counts = Counter[str]()  # of messages with the types, as far as they are known
        counts = Counter[tuple[str, str]]()
        self.unusable: dict[str, str] = {}  # why no picture of a topic can be used
        damage = []
        for file in map(open_file, files):
            file.topics()
            self.every |= {(one.topic, one.type_name): one for one in file.channels.values()}
            for one, count in file.counts().items():
                counts[one] += count
            losses = sorted(file.losses, key=lambda loss: not loss.what)
            if losses and not any(file.counts().values()):
                damage.append(f'{file.path}: holds no message that can be read; '
                              f'{describe(losses)[0]}')
        for (topic, kind), channel in self.every.items():
            if topic not in self.channels or kind in (_named_best(topic) or IMAGE).types:
                self.channels[topic] = channel
        for (topic, kind), count in counts.items():
            if kind in self.types(topic):
                self.counts[topic] += count
        if not self.channels or (counts and not any(counts.values())):
            raise RecordingError(damage[0] if damage else f'{self.source}: holds no message')

    def camera(self, wanted: str) -> str:
        """Return the camera's topic."""
        pictures = [topic for topic, channel in self.channels.items()
                    if channel.type_name in IMAGE.types]
        if wanted:
            if wanted not in pictures and f'{wanted}/compressed' in pictures:
                wanted = f'{wanted}/compressed'
            if wanted not in pictures:
                raise RecordingError(f'{self.source}: no topic {escaped(wanted)} of type '
                                     f'{" or ".join(IMAGE.types)}; {self.known}')
            if self.counts.get(wanted) == 0:
                raise RecordingError(f'{self.source}: topic {escaped(wanted)} holds no message; '
                                     f'{self.known}')
            return wanted
        left = [topic for topic in pictures if self.counts.get(topic) != 0
                and _named_best(topic) in (None, IMAGE)] or [
                topic for topic in pictures if _named_best(topic) is IMAGE]
        most = max((self.counts.get(topic, 0) for topic in left), default=0)
        rules: tuple[Callable[[str], object], ...] = (
            self.is_main_one,
            lambda topic: _named_best(topic) is IMAGE and self.picture(topic) is not None,
            lambda topic: self.counts.get(topic, most) * _FEW > most,
            lambda topic: self.picture(topic) is not None,
            # Of a camera that is there raw, too, nothing more is learned from compressed pictures.
            lambda topic: _plain(topic) == topic or _plain(topic) not in left,
            self.is_coloured)
        for rule in rules:
            if len(left) > 1:
                left = [topic for topic in left if rule(topic)] or left
        if not left and (why := explain(self.channels.values())):
            raise RecordingError(f'{self.source}: {why}; {self.known}')
        if not left:
            raise RecordingError(
                f'{self.source}: no topic ends in {IMAGE.recorded} with type {IMAGE.type}; name '
                f'the camera topic (--image-topic) if it is called otherwise; {self.known}')
        if all(self.picture(topic) is None for topic in left) and len(left) > 1:
            why = '; '.join(f'{escaped(topic)}: {self.unusable[topic]}' for topic in left[:3])
            raise RecordingError(f'{self.source}: none of its topics of pictures can be used: '
                                 f'{self.listing(left)}; {why}')
        if len(left) > 1:
            raise RecordingError(
                f'{self.source}: several topics could be {IMAGE.recorded}: {self.listing(left)}; '
                'name the camera topic (--image-topic)')
        return left[0]

    def types(self, topic: str) -> tuple[str, ...]:
        """Return the types of a topic's messages that are read."""
        kind = self.channels[topic].type_name
        return IMAGE.types if kind in IMAGE.types else (kind,)

    def is_main_one(self, topic: str) -> bool:
        """Tell whether its other topic, raw or compressed, has less than twice its pictures."""
        raw = _plain(topic)
        other = raw if raw != topic else f'{topic}/compressed'
        return not (0 < 2 * self.counts[topic] <= self.counts[other]
                    and self.channels[other].type_name in IMAGE.types
                    and self.picture(other) is not None)

    def beside(self, one: Topic, camera: str) -> list[str]:
        """Return the topics that are read as one of ours, beside a camera."""
        found = [topic for topic, channel in self.channels.items()
                 if channel.type_name in one.types and _named_best(topic) is one
                 and self.counts.get(topic) != 0]
        found = [topic for topic in found if _plain(topic) == topic or _plain(topic) not in found]
        above = [topic for topic in found
                 if camera.startswith(_plain(topic).removesuffix(one.name))]
        if above or len(found) < 2:
            return sorted(above, key=len)[-1:] or found
        if one is JOINT_STATES:
            told, arms = {topic: self.joints(topic) for topic in found}, known_arms()
            places = [topic for topic, names in told.items() if find_joints(names, arms)
                      or names.keys() & set(PLACE)]
            found = [topic for topic in found if topic in places
                     or told[topic].keys() & set(GRIPPER_JOINTS)]
            if len(places) < 2:
                return found
        warnings.warn(
            f'{self.source}: several topics could be {one.recorded}: {self.listing(found)}; none '
            'is read, as none is in the namespace of the camera', RecordingWarning, stacklevel=4)
        return []

    def picture(self, topic: str) -> np.ndarray | None:
        """Return one of the first pictures of a topic, None without any that can be used."""
        self.unusable[topic] = 'damaged'
        for message in self._first(topic):
            try:
                return decode_image(message)
            except ImageError as error:
                self.unusable[topic] = str(error)
        return None

    def is_coloured(self, topic: str) -> bool:
        """Tell whether one of the first pictures of a topic has colours."""
        picture = self.picture(topic)
        return picture is not None and bool(np.ptp(picture, -1).any())

    def joints(self, topic: str) -> Mapping[str, float]:
        """Return the joints in the first message of a topic."""
        return next((decode_positions(message) for message in self._first(topic)), {})

    def listing(self, topics: Sequence[str]) -> str:
        """List topics with the number of their messages."""
        return listing((f'{topic} ({self.counts.get(topic, "?")} messages)'
                        for topic in sorted(topics)), 20)

    @cached_property
    def known(self) -> str:
        """All topics, in words."""
        return 'topics found: ' + (listing((
            f'{topic} ({channel.type_name}, {self.counts.get(topic, "?")} messages)'
            for topic, channel in sorted(self.channels.items())), 20) or 'none')

    def _first(self, topic: str) -> list[Any]:
        """Return the first messages of a topic that can be decoded."""
        found, types = [], self.types(topic)
        for file in map(open_file, self.files):
            fitting = (one for one in file.messages({topic}) if one[0].type_name in types)
            for channel, *_, data in islice(fitting, _LOOKED_AT):
                with suppress(RecordingError):
                    found.append(decode(channel.type_name, data))
            if found:
                break
        return found


def _plain(topic: str) -> str:
    """Return the topic of raw pictures."""
    return topic.removesuffix('/compressed')


def _named_best(name: str) -> Topic | None:
    """Return the Topic whose name is the longest that a full name ends in."""
    return max((topic for topic in TOPICS if topic.is_called(name)),
               key=lambda topic: len(topic.name), default=None)
