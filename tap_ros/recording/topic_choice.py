# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which topics of a recording are read.

By what is needed: by type, name and namespace, by the number of messages and, where several would
do, by what is in them. Only where two cameras are left is somebody asked.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS
from tap_ros.base.errors import ImageError, RecordingError
from tap_ros.base.text import escaped, listing
from tap_ros.messages.images import decode_image
from tap_ros.messages.joints import decode_positions, PLACE
from tap_ros.messages.topics import (
    BY_COLUMNS,
    CONTROL_PERIOD,
    IMAGE,
    JOINT_STATES,
    Topic,
    TOPICS,
    TWIST,
)
from tap_ros.recording.columns import first_size
from tap_ros.recording.defects import describe
from tap_ros.recording.mcap_file import Channel, McapFile
from tap_ros.recording.messages import check_schema, decode
from tap_ros.recording.sqlite_file import open_file
from tap_ros.robots.arm import find_joints, known_arms

_PACKETS = 'FFMPEGPacket', 'CompressedVideo', 'theora_image_transport/msg/Packet'  # types
Counts: TypeAlias = dict[tuple[str, str], int | None]  # by topic and type
_LOOKED_AT = 5  # messages, as the first may be damaged
_FEW = 20  # of a picture topic are so many times fewer than of a camera


def list_paths(paths: Sequence[str | Path]) -> str:
    """Name the first of several files and how many more there are."""
    return str(paths[0]) + (f' and {len(paths) - 1} more' if len(paths) > 1 else '')


def total(parts: Iterable[Counts]) -> Counts:
    """Add up the numbers of messages; what one part does not know nobody does."""
    found: Counts = {}
    for part in parts:
        for key, count in part.items():
            before = found.get(key, 0)
            found[key] = None if before is None or count is None else before + count
    return found


@dataclass(frozen=True)
class Choice:
    """
    What of a bag is read.

    :param topics: names of columns, Topic.becomes, by topic; the camera's is the first.
    :param size: (height, width) of the first picture, before it is cut; None without any.
    :param doubts: lines to warn of.
    """

    topics: dict[str, str]
    size: tuple[int, int] | None
    doubts: list[str] = field(default_factory=list)


class Bag:
    """
    A recording: files in playing order, each opened once, when something of it is asked.

    :param files: paths of .mcap or .db3 files.
    :ivar source: what messages call it.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files, self.source = tuple(files), list_paths(files)
        self._opened: dict[Path, McapFile] = {}

    def choose(self, image_topic: str = '') -> Choice:
        """
        Choose the topics that are read.

        :param image_topic: the camera's topic; by default it is found.
        :raises RecordingError: without a camera, when several would do, and for messages that
            cannot be read.
        """
        if all(count == 0 for count in self.held.values()):
            why = next((f'{file.path}: holds no message that can be read; '
                        f'{describe(sorted(file.defects, key=lambda one: not one.what))[0]}'
                        for file in self.opened if file.defects and not any(
                            file.counts().values())), f'{self.source}: holds no message')
            raise RecordingError(why)
        camera, doubts = self._camera(image_topic), list[str]()
        topics, near = {camera: IMAGE.becomes}, camera
        for name, one in BY_COLUMNS.items():
            if one is CONTROL_PERIOD:  # of the commands, whatever the namespace of the camera
                near = next((topic for topic in topics if topics[topic] == TWIST.becomes), camera)
            if one is not IMAGE:
                topics |= dict.fromkeys(self._beside(one, near, doubts), name)
            near = camera
        for channel in self._every:
            if channel.topic not in topics or channel.type_name not in self._types(channel.topic):
                continue
            source = f'{self.source}: topic {escaped(channel.topic)}'
            if channel.encoding != 'cdr':
                raise RecordingError(
                    f'{source}: encoded as {channel.encoding[:40]!r}; only cdr can be read')
            if channel.schema_encoding == 'ros2msg':
                try:
                    check_schema(channel.type_name, channel.schema)
                except RecordingError as error:
                    raise RecordingError(f'{source}: {error}') from error
        sizes = (first_size(file, camera) for file in self.opened)
        choice = Choice(topics, next(filter(None, sizes), None), doubts)
        for file in self.opened:
            file.close()
        return choice

    def file(self, path: Path) -> McapFile:
        """
        Return one of the files, opened.

        :raises RecordingError: when nothing of it can be read.
        """
        if path not in self._opened:
            self._opened[path] = open_file(path)
        return self._opened[path]

    @property
    def opened(self) -> list[McapFile]:
        """All files; raises as `file`."""
        return list(map(self.file, self.files))

    @cached_property
    def _every(self) -> list[Channel]:
        """The channels, one a topic and type."""
        return list({(one.topic, one.type_name): one for file in self.opened
                     for one in file.channels.values()}.values())

    @cached_property
    def held(self) -> Counts:
        """The numbers of messages by topic and type; None where nothing tells it."""
        return total(file.counts() for file in self.opened)

    @cached_property
    def channels(self) -> dict[str, Channel]:
        """A channel by topic; of several types the one that fits the name."""
        found: dict[str, Channel] = {}
        for one in self._every:
            if one.topic not in found or one.type_name in (_named_best(one.topic) or IMAGE).types:
                found[one.topic] = one
        return found

    @cached_property
    def _counts(self) -> dict[str, int]:
        """The numbers of messages of the types that are read, by topic, as far as known."""
        found: dict[str, int] = {}
        for (topic, kind), count in self.held.items():
            if kind in self._types(topic) and count is not None:
                found[topic] = found.get(topic, 0) + count
        return found

    def _camera(self, wanted: str) -> str:
        """Return the camera's topic."""
        pictures = [topic for topic, channel in self.channels.items()
                    if channel.type_name in IMAGE.types]
        if wanted:
            if wanted not in pictures and f'{wanted}/compressed' in pictures:
                wanted = f'{wanted}/compressed'
            if wanted not in pictures:
                raise RecordingError(f'{self.source}: no topic {escaped(wanted)} of type '
                                     f'{" or ".join(IMAGE.types)}; {self._known}')
            if self._counts.get(wanted) == 0:
                raise RecordingError(f'{self.source}: topic {escaped(wanted)} holds no message; '
                                     f'{self._known}')
            return wanted
        left = [topic for topic in pictures if self._counts.get(topic) != 0
                and _named_best(topic) in (None, IMAGE)] or [
                topic for topic in pictures if _named_best(topic) is IMAGE]
        most = max((self._counts.get(topic, 0) for topic in left), default=0)
        rules: tuple[Callable[[str], object], ...] = (
            self._is_main_one,
            lambda topic: _named_best(topic) is IMAGE and self._is_usable(topic),
            lambda topic: self._counts.get(topic, most) * _FEW > most,
            lambda topic: self._is_usable(topic),
            # Of a camera that is there raw, too, nothing more is learned from compressed pictures.
            lambda topic: _plain(topic) == topic or _plain(topic) not in left,
            self._is_coloured)
        for rule in rules:
            if len(left) > 1:
                left = [topic for topic in left if rule(topic)] or left
        if not left:
            why = _explain(self.channels.values())
            raise RecordingError(f'{self.source}: ' + (why or (
                f'no topic ends in {IMAGE.recorded} with type {IMAGE.type}; name the camera topic '
                '(--image-topic) if it is called otherwise')) + f'; {self._known}')
        if len(left) > 1 and not any(map(self._is_usable, left)):
            why = '; '.join(f'{escaped(topic)}: {self._picture(topic)}' for topic in left[:3])
            raise RecordingError(f'{self.source}: none of its topics of pictures can be used: '
                                 f'{self._listing(left)}; {why}')
        if len(left) > 1:
            raise RecordingError(
                f'{self.source}: several topics could be {IMAGE.recorded}: {self._listing(left)}; '
                'name the camera topic (--image-topic)')
        return left[0]

    def _types(self, topic: str) -> tuple[str, ...]:
        """Return the types of a topic's messages that are read."""
        kind = self.channels[topic].type_name
        return IMAGE.types if kind in IMAGE.types else (kind,)

    def _is_main_one(self, topic: str) -> bool:
        """Return whether its other topic, raw or compressed, has less than twice its pictures."""
        raw = _plain(topic)
        other = raw if raw != topic else f'{topic}/compressed'
        return not (0 < 2 * self._counts.get(topic, 0) <= self._counts.get(other, 0)
                    and self.channels[other].type_name in IMAGE.types
                    and self._is_usable(other))

    def _beside(self, one: Topic, camera: str, doubts: list[str]) -> list[str]:
        """Return the topics that are read as one of ours, beside a camera or the commands."""
        found = [topic for topic, channel in self.channels.items()
                 if channel.type_name in one.types and _named_best(topic) is one]
        held = [topic for topic in found if self._counts.get(topic) != 0]
        # Later files of a bag tell that there was a period, in m/s, which the first one holds.
        found = held or (found if one is CONTROL_PERIOD else [])
        found = [topic for topic in found if _plain(topic) == topic or _plain(topic) not in found]
        above = [topic for topic in found
                 if camera.startswith(_plain(topic).removesuffix(one.name))]
        if above or len(found) < 2:
            return sorted(above, key=len)[-1:] or found
        if one is CONTROL_PERIOD:
            doubts.append(f'several topics could be {one.recorded}: {self._listing(found)}; what '
                          'any of them told last is taken')
            return found
        if one is JOINT_STATES:
            told = {topic: next(map(decode_positions, self._first(topic)), {}) for topic in found}
            places = [topic for topic, names in told.items()
                      if find_joints(names, known_arms()) or names.keys() & set(PLACE)]
            found = [topic for topic in found if topic in places
                     or told[topic].keys() & set(GRIPPER_JOINTS)]
            if len(places) < 2:
                return found
        doubts.append(
            f'several topics could be {one.recorded}: {self._listing(found)}; none is read, as '
            'none is in the namespace of the camera')
        return []

    def _picture(self, topic: str) -> np.ndarray | str:
        """Return one of the first pictures of a topic, or why none of them can be used."""
        why = 'damaged'
        for message in self._first(topic):
            try:
                return decode_image(message)
            except ImageError as error:
                why = str(error)
        return why

    def _is_usable(self, topic: str) -> bool:
        """Return whether one of the first pictures of a topic can be used."""
        return isinstance(self._picture(topic), np.ndarray)

    def _is_coloured(self, topic: str) -> bool:
        """Return whether one of the first pictures of a topic has colours."""
        picture = self._picture(topic)
        return isinstance(picture, np.ndarray) and bool(np.ptp(picture, -1).any())

    def _listing(self, topics: Sequence[str]) -> str:
        """List topics with the number of their messages."""
        return listing((f'{topic} ({self._counts.get(topic, "?")} messages)'
                        for topic in sorted(topics)), 20)

    @cached_property
    def _known(self) -> str:
        """All topics, in words."""
        return 'topics found: ' + (listing((
            f'{topic} ({channel.type_name}, {self._counts.get(topic, "?")} messages)'
            for topic, channel in sorted(self.channels.items())), 20) or 'none')

    def _first(self, topic: str) -> list[Any]:
        """Return the first messages of a topic that can be decoded."""
        found, types = [], self._types(topic)
        for file in self.opened:
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


def _explain(channels: Collection[Channel]) -> str:
    """Return why a bag has no camera that can be read, and what helps; '' if unknown."""
    for channel in channels:
        if channel.type_name.endswith(_PACKETS):
            return (f'topic {escaped(channel.topic)} holds packets of a video, which are not '
                    'read; record the topic of its raw or compressed pictures, or those that '
                    'image_transport republish makes of it')
    other = sorted({channel.encoding for channel in channels} - {'cdr'})
    return f'its messages are encoded as {listing(other)}; only those of ROS 2 are read; ' \
        'record its topics' if other else ''
