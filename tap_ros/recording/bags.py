# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Find recordings at a path; say what it holds instead, and the command that helps."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from itertools import islice, product
import os
from pathlib import Path
import re
import shlex
from typing import Any, TypeAlias
import warnings

from mcap.writer import MCAP0_MAGIC as MAGIC
from tap_ros.base.errors import ConfigError, RecordingError, RecordingWarning
from tap_ros.base.text import escaped, listing
from tap_ros.images.crop import CENTRE, TrainedCrop
from tap_ros.recording.metadata import bag_files, FILE_NAME, files_by_number, natural
from tap_ros.recording.raw_files import beginning, stats_of
from tap_ros.recording.reading import Reading
from tap_ros.recording.sqlite_file import SQLITE
from tap_ros.recording.topic_choice import Bag, list_paths, total

VIDEOS = ('.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.h264')
_MOST_FILES = 10000  # of a folder that are looked at
_PACKED = {  # by how a file begins: what it is, and the command that makes it readable
    b'\x1f\x8b': ('packed by gzip', 'gzip -dk {}'), b'BZh': ('packed by bzip2', 'bzip2 -dk {}'),
    b'\xfd7zXZ': ('packed by xz', 'xz -dk {}'), b'\4"M\x18': ('packed by lz4', 'lz4 -dk {}'),
    b'PK\3\4': ('a zip archive', 'unzip {}'),
    b'version https://git-lfs': ('what Git LFS left in place of the file', 'git lfs pull')}
Paths: TypeAlias = 'str | Path | Bag | Iterable[str | Path | Bag]'


def find_bags(paths: Paths) -> list[Bag]:
    """
    Find recordings.

    :param paths: one or several .mcap files, bag folders, or folders of bag folders; a Bag stays.
    :return: list of Bag, in the order of the paths, those of a folder by the numbers in their
        names. No file is opened yet.
    :raises RecordingError: where there is none; it says what is there instead.
    """
    bags: list[Bag] = []
    for path in [paths] if isinstance(paths, (str, os.PathLike, Bag)) else paths:
        bags += [path] if isinstance(path, Bag) else map(Bag, _find(Path(path)))
    return bags


def known_bags(paths: Paths) -> list[Bag]:
    """
    Find recordings as find_bags does; one that was found before is the same Bag, opened once.

    :raises RecordingError: if there is none, or one cannot be read.
    """
    return [_known(bag.files, tuple(map(stats_of, bag.files))) for bag in find_bags(paths)]


@lru_cache(1000)
def _known(files: Sequence[Path], stats: tuple[object, ...]) -> Bag:
    """Return a Bag, another one when a file of it has changed."""
    return Bag(files)


def _find(path: Path) -> list[list[Path]]:
    """Return the files of each bag at a path, in playing order."""
    try:
        if path.is_file():
            if (path.suffix != '.mcap' and not beginning(path).startswith((MAGIC, SQLITE))
                    and (why := what_is(path))):
                raise RecordingError(f'{escaped(path)}: {why}')
            bags = [[path]]
        elif not path.is_dir():
            raise RecordingError(
                f'{path}: there is no such file or folder' if not path.exists() else
                f'{path}: neither a regular file nor a folder')
        elif files := _files(path):
            bags = [files]
            _warn_of_more(path)
        else:
            bags = [files for part in sorted(path.iterdir(), key=natural) if part.is_dir()
                    and (files := _files(part))]
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
    if not bags:
        raise RecordingError(f'{path}: ' + (what_is(path) or (
            f'holds no recording; expected .mcap files, with {FILE_NAME} beside them, or folders '
            'of such')))
    for file in (file for files in bags for file in files):
        if why := what_else(file):
            raise RecordingError(f'{file}: {why}')
    return bags


def _warn_of_more(path: Path) -> None:
    """Warn of recordings in folders of a bag."""
    more = [part.name for part in sorted(path.iterdir(), key=natural)
            if part.is_dir() and any(part.glob('*.mcap'))]
    if more:
        warnings.warn(RecordingWarning(
            f'{escaped(path)}: is a recording itself; those in {listing(more, 5)} in it are left '
            'out, name them'), stacklevel=2)


def _files(folder: Path) -> list[Path]:
    """Return the files of the bag in a folder; none of what is no bag."""
    found = [file for file in files_by_number(folder, '.db3')
             if beginning(file).startswith(SQLITE)]
    if not any(folder.glob('*.mcap*')) and found:
        return found
    if found and not (folder / FILE_NAME).exists():  # which says what belongs to the bag
        raise RecordingError(
            f'{escaped(folder)}: holds .mcap files and {listing([file.name for file in found])}, '
            'which are no parts of one bag; give the files one by one, or move those of a bag '
            'into a folder of its own')
    return bag_files(folder)


def what_is(path: Path) -> str:
    """Return what something is that is no bag, and the command that makes one; '' if unknown."""
    for folder in (path, *path.absolute().parents[:4]):
        if (folder / 'meta' / 'info.json').is_file():
            return _advice('LeRobot data', 'import-lerobot', folder)
    if path.name.endswith('.zarr.zip') or any((path / name).is_file() for name in (
            '.zgroup', '.zarray', '.zattrs', 'zarr.json')):
        return ('a zarr store, which is not read, as it may hold code; most such sets are on '
                "LeRobot's hub (hf download lerobot/pusht --repo-type dataset --local-dir pusht),"
                ' for import-lerobot')
    for file in (path, *(islice(path.rglob('*'), _MOST_FILES) if path.is_dir() else ())):
        if '.tfrecord' in file.name:
            return _advice('TFRecord files, as of RLDS', 'import-tfrecord', path)
        if file.suffix.lower() in VIDEOS and file.is_file():
            return _advice('video', 'import-video', path)
        start = beginning(file)
        if start.startswith(b'\x89HDF'):
            return _advice('HDF5, as of ALOHA and robomimic', 'import-arrays', path)
        if start.startswith(b'#ROSBAG'):
            whole, bag = (shlex.quote(escaped(one, 400)) for one in (file, file.with_suffix('')))
            return ('a bag of ROS 1; make one of ROS 2 of it: rosbags-convert --src '
                    f'{whole} --dst {bag} --dst-storage mcap')
    return ''


def _advice(what: str, command: str, place: Path) -> str:
    return (f'no recording of ROS, but {what}; make one of it: python -m tap_ros {command} '
            f'{shlex.quote(escaped(place, 400))} --out BAG')


def what_else(path: Path) -> str:
    """Return why a file cannot be read as it is, and the command that helps; '' if unknown."""
    start = beginning(path)
    for magic, (what, command) in _PACKED.items():
        if start.startswith(magic):
            if 'packed' in what and re.search(r'[.](tar[.]\w+|tgz)$', path.name):
                command = 'tar -xf {}'
            place = shlex.quote(escaped(path, 400))
            return f'it is {what}; type `{command.format(place)}`'
    return ''


def list_topics(paths: Paths) -> list[tuple[str, str, int | None]]:
    """
    List what recordings hold, whether it can be used or not.

    :param paths: as find_bags takes them.
    :return: (topic, type, number of messages, None where unknown), by name.
    :raises RecordingError: when there is no recording, or nothing of a file can be read.
    """
    return [(topic, kind, count) for (topic, kind), count in sorted(
        total(bag.held for bag in find_bags(paths)).items())]


def reading_like(training: Mapping[str, Any], paths: Paths, image_topic: str = '',
                 trained: TrainedCrop | None = None) -> Reading:
    """
    Return how recordings are read as those of a training were.

    :param training: the training dict of a weights file, of any version; what it does not tell is
        as by default.
    :param paths: of the recordings, as find_bags takes them.
    :param image_topic: the camera's topic; by default that of the training where all of them have
        it, else as topic_choice finds it.
    :param trained: TrainedCrop of the weights; pictures of other cameras are cut as nodes cut
        them.
    :raises RecordingError: when a recording is missing, or nothing of it can be read.
    :raises ImageError: for pictures that cannot be cut as in training; it names the recording.
    """
    bags, settings = find_bags(paths), training.get('settings')
    settings = settings if isinstance(settings, dict) else {}
    known = {
        field.name: settings[field.name] for field in fields(Reading)
        if field.name != 'image_topic'
        and isinstance(settings.get(field.name), (str,) if field.type is str else (int, float))}
    usual = settings.get('image_topic') or ()
    usual = (usual,) if isinstance(usual, str) else tuple(usual)
    topics: str | tuple[str, ...] = image_topic
    if usual and not image_topic and all({*usual} <= bag.channels.keys() for bag in bags):
        topics = usual
    try:
        reading = Reading(topics, **known)
    except ConfigError:
        reading = Reading(topics)
    if trained is None:
        return reading
    cuts = set()
    for bag, camera in product(bags, reading.cameras):
        if size := bag.choose(camera).size:
            cuts.add(trained.of(size, str(bag.files[0])))
            if why := trained.unlike(size, str(bag.files[0])):
                warnings.warn(escaped(why, 500), RecordingWarning, stacklevel=2)
    if len(cuts) > 1 and reading.crop not in ('', CENTRE):
        raise RecordingError(f'{list_paths([bag.files[0] for bag in bags])}: some pictures are '
                             f'cut to {reading.crop} already, others are not; score them apart')
    cut = cuts.pop() if len(cuts) == 1 else reading.cut
    return replace(reading, crop=cut.part, size=cut.size)
