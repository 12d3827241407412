# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find the bags at a path, their files and their topics; say what is wrong with them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
import itertools
from pathlib import Path
from typing import Any
import warnings

from tap_ros.base.errors import ConfigError, ImageError, RecordingError
from tap_ros.base.text import escaped
from tap_ros.images.crop import CENTRE, check_trainable, TrainedCrop
from tap_ros.recording.columns import Columns, first_size
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.foreign import open_file, recognise
from tap_ros.recording.metadata import bag_files, FILE_NAME, files_by_number, natural
from tap_ros.recording.reading import Reading
from tap_ros.recording.topic_choice import find_topics, list_paths


def find_bags(path: str | Path) -> list[list[Path]]:
    """
    Return the bags at a path: a list of lists of .mcap files, in playing order.

    :param path: .mcap file, bag folder, or folder of bag folders.
    :raises RecordingError: when there is none.
    """
    path = Path(path)
    try:
        foreign = recognise(path) if path.exists() else None
        if foreign is not None:
            return foreign
        if path.is_file():
            return [[path]]
        if not path.is_dir():
            raise RecordingError(
                f'{path}: there is no such file or folder' if not path.exists() else
                f'{path}: neither a regular file nor a folder')
        folders = [path] if _is_bag(path) else sorted(
            filter(_is_bag, path.iterdir()), key=natural)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
    bags = [files for folder in folders if (files := bag_files(folder))]
    if not bags:
        raise RecordingError(
            f'{path}: holds no recording; expected .mcap files, with {FILE_NAME} beside them, '
            'or folders of such')
    return bags


def list_topics(path: str | Path) -> list[tuple[str, str, int | None]]:
    """
    List what recordings hold, whether it can be used or not.

    :param path: .mcap file, bag folder, or folder of bag folders.
    :return: (topic, type, number of messages, None where unknown), by name.
    :raises RecordingError: when there is no recording, or nothing of a file can be read.
    """
    found: dict[tuple[str, str], int | None] = {}
    for file in (open_file(file) for bag in find_bags(path) for file in bag):
        file.topics()
        counts = file.counts()
        for one in {(channel.topic, channel.type_name) for channel in file.channels.values()}:
            before, count = found.get(one, 0), counts.get(one)
            found[one] = None if before is None or count is None else before + count
    return [(topic, kind, count) for (topic, kind), count in sorted(found.items())]


def reading_like(training: Mapping[str, Any], paths: Sequence[str | Path],
                 image_topic: str = '', trained: TrainedCrop | None = None) -> Reading:
    """
    Return how recordings are read as those of a training were.

    :param training: the training dict of a weights file, of any version; what it does not tell is
        as by default.
    :param paths: of the recordings.
    :param image_topic: the camera's topic; by default that of the training where all of them have
        it, else as topic_choice finds it.
    :param trained: TrainedCrop of the weights; pictures of other cameras are cut as nodes cut
        them.
    :raises RecordingError: when a recording is missing, or nothing of it can be read.
    :raises ImageError: for pictures that cannot be cut as in training; it names the recording.
    """
    settings = training.get('settings')
    settings = settings if isinstance(settings, dict) else {}
    known = {
        field.name: settings[field.name] for field in fields(Reading)
        if field.name != 'image_topic'
        and isinstance(settings.get(field.name), (str,) if field.type is str else (int, float))}
    usual = settings.get('image_topic') or ()
    usual = (usual,) if isinstance(usual, str) else tuple(usual)
    topics: str | tuple[str, ...] = image_topic
    if not image_topic and all(set(usual) <= {topic for topic, _, _ in list_topics(path)}
                               for path in paths):
        topics = usual
    try:
        reading = Reading(topics, **known)
    except ConfigError:
        reading = Reading(topics)
    if trained is None:
        return reading
    cuts = set()
    for bag, size in _first_sizes(paths, reading):
        cuts.add(trained.of(size, str(bag)))
        if why := trained.unlike(size, str(bag)):
            warnings.warn(escaped(why, 500), RecordingWarning, stacklevel=2)
    if len(cuts) > 1 and reading.crop not in ('', CENTRE):
        raise RecordingError(f'{list_paths(paths)}: some pictures are cut to {reading.crop} '
                             'already, others are not; score them apart')
    cut = cuts.pop() if len(cuts) == 1 else reading.cut
    return replace(reading, crop=cut.part, size=cut.size)


def check_first_picture(paths: Iterable[str | Path], reading: Reading, network: str) -> None:
    """
    Refuse recordings that no network of ours takes, before they are decoded.

    :param paths: .mcap files, bag folders, or folders of bag folders.
    :param reading: Reading.
    :param network: what errors call it.
    :raises ConfigError: for pictures of a size that it cannot have, see crop.check_trainable, and
        for one part of pictures of several sizes.
    :raises RecordingError: when a recording is missing, or lacks the image topic.
    """
    sizes = set()
    for _, size in _first_sizes(paths, reading):
        sizes.add(size)
        with suppress(ImageError):  # whoever opens it is told
            check_trainable(reading.cut.cut_size(size), network)
    if len(sizes) > 1 and reading.crop not in ('', CENTRE):
        found = ', '.join('{1}x{0}'.format(*size) for size in sorted(sizes))
        raise ConfigError(f'recordings: pictures of different sizes, {found}; --crop '
                          f'{reading.crop} is another part of each, use --crop {CENTRE} or '
                          'train on them apart')


def _first_sizes(paths: Iterable[str | Path],
                 reading: Reading) -> Iterator[tuple[Path, tuple[int, int]]]:
    """Yield the first file of each bag, and the (height, width) of a first picture in it."""
    for bag, camera in itertools.product(
            (bag for path in paths for bag in find_bags(path)), reading.cameras):
        size = first_size(bag, next(iter(find_topics(bag, camera))))
        if size is not None:
            yield bag[0], size


def check_sizes(parts: Sequence[Columns]) -> None:
    """Refuse recordings whose images differ in size, naming them."""
    sizes: dict[tuple[int, int], str] = {}
    for part in parts:
        if part.image_size is not None:
            sizes.setdefault(part.image_size, part.source)
    if not sizes:
        why = next((f'{part.source}: {part.damage[0]}' for part in parts if part.damage), '')
        raise RecordingError(
            f'{list_paths([part.source for part in parts])}: the image topic holds no image'
            + (f' that can be used; {why}' if why else ''))
    if len(sizes) > 1:
        listing = ', '.join(f'{s} ({w}x{h})' for (h, w), s in sizes.items())
        raise RecordingError(
            f'images of different sizes (width x height): {listing}; open them separately')


def warn_of_damage(part: Columns) -> None:
    """Say what could not be used of a file, in one warning a cause."""
    for line in part.damage:
        warnings.warn(f'{escaped(part.source)}: {line}', RecordingWarning, stacklevel=3)


def _is_bag(path: Path) -> bool:
    return path.is_dir() and bool((path / FILE_NAME).exists() or files_by_number(path))
