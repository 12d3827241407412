# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is given as a recording: MCAP, sqlite3, or something else that is explained."""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from itertools import islice
import os
from pathlib import Path
import re
import shlex
import sqlite3

from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC
from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped, listing
from tap_ros.recording.damage import FAR, Loss
from tap_ros.recording.file_bytes import bytes_of, PACKED, unpacked_name
from tap_ros.recording.mcap_file import Channel, Found, McapFile
from tap_ros.recording.metadata import bag_files, FILE_NAME, natural
from tap_ros.recording.trust import Budget
import zstandard

VIDEOS = ('.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.h264')
_PACKETS = 'FFMPEGPacket', 'CompressedVideo', 'theora_image_transport/msg/Packet'  # types
SQLITE = b'SQLite format 3\0'
_MOST_FILES = 10000  # of a folder that are looked at


class SqliteFile(McapFile):
    """A file of a bag that ROS 2 keeps in sqlite3, read as McapFile reads one of MCAP."""

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.losses: list[Loss] = []
        self._counts = Counter[int]()
        self._summary, self._is_read = Summary(), True  # the number of messages is known
        self._budget = Budget(os.stat(path).st_size)
        self._newest: int | None = None
        try:
            with closing(self._open()) as base:
                self._describe(base)
        except (sqlite3.Error, ValueError) as error:
            raise RecordingError(
                f'{escaped(path)}: cannot be read: {escaped(error)}; copy it again') from error

    def _describe(self, base: sqlite3.Connection) -> None:
        """Learn of the channels, and how many messages each has."""
        for name, text in base.execute(  # a view or a formula may have no end
                "SELECT name, sql FROM sqlite_master WHERE type IN ('table', 'view') "
                "AND name IN ('topics', 'messages', 'message_definitions')"):
            if not re.match(r'CREATE TABLE\b', text) or re.search(r'(?i)\bAS\b', text):
                raise ValueError(f'{name} is no plain table')
        texts = dict[str, str]()
        with suppress(sqlite3.Error):  # bags before Iron have none
            texts = dict(base.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions '
                "WHERE encoding = 'ros2msg'"))
        for number, topic, kind, encoding in base.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            text = texts.get(kind, '')
            if not all(isinstance(word, str) for word in (topic, kind, encoding, text)):
                raise ValueError('topics holds what is no text')
            self.channels[number] = Channel(
                topic, kind, encoding, 'ros2msg' if text else '', text)
        self._counts.update(dict(base.execute(
            'SELECT topic_id, count(*) FROM messages GROUP BY topic_id')))

    def _blocks(self) -> Iterator[list[Found]]:
        try:
            with closing(self._open()) as base:
                for number, log, data in base.execute(
                        'SELECT topic_id, timestamp, data FROM messages ORDER BY id'):
                    if not isinstance(log, int) or not isinstance(data, bytes):
                        self.losses.append(Loss('it holds no message', 'row', cuts=False))
                        continue
                    self._newest = min(log, FAR)
                    yield [(number, log, log, memoryview(data))]
        except sqlite3.Error as error:
            behind = None if self._newest is None else self._newest + 1
            self.losses.append(Loss(f'all behind is lost: {escaped(error)}', start=behind,
                                    end=self._newest))

    def _conclude(self, wanted: Collection[str]) -> None:
        """Leave it to what _blocks said."""

    def _open(self) -> sqlite3.Connection:
        """Open the file, with what a killed recorder left beside it; nothing there is changed."""
        path = Path(self.path)
        if path.suffix in PACKED:
            base = sqlite3.connect(':memory:')
            base.deserialize(bytes_of(path))
            return base
        way = 'mode=ro' if path.with_name(f'{path.name}-wal').is_file() else 'immutable=1'
        return sqlite3.connect(f'{path.absolute().as_uri()}?{way}', uri=True)


def recognise(path: Path) -> list[list[Path]] | None:
    """
    Return the bags at a path that are not MCAP: a list of lists of files, in playing order.

    :param path: of a file or folder that exists.
    :return: what open_file reads; None for what may be MCAP.
    :raises RecordingError: for what cannot be read; it says what it is, and a command that helps.
    """
    if bag := _bag(path):
        return [bag]
    if path.suffix == '.mcap' or _start(path).startswith(MAGIC):
        return None
    if path.is_dir():
        parts = sorted((part for part in path.iterdir() if part.is_dir()), key=natural)
        if any(map(_bag, parts)):
            return [files for part in parts if (files := _bag(part) or bag_files(part))]
        if any(next(path.glob(names), None) for names in ('*.mcap*', '*/*.mcap*')):
            return None
    if what := what_is(path):
        raise RecordingError(f'{escaped(path)}: {what}')
    return None


def explain(channels: Collection[Channel]) -> str:
    """Return why a bag has no camera that can be read, and what helps; '' if unknown."""
    for channel in channels:
        if channel.type_name.endswith(_PACKETS):
            return (f'topic {escaped(channel.topic)} holds packets of a video, which are not '
                    'read; record the topic of its raw or compressed pictures, or those that '
                    'image_transport republish makes of it')
    other = sorted({channel.encoding for channel in channels} - {'cdr'})
    return f'its messages are encoded as {listing(other)}; only those of ROS 2 are read; ' \
        'record its topics' if other else ''


def open_file(path: str | Path) -> McapFile:
    """
    Open one file of a bag.

    :param path: as find_bags returns it.
    :raises RecordingError: as McapFile.
    """
    return (SqliteFile if _is_sqlite(Path(path)) else McapFile)(path)


def _bag(path: Path) -> list[Path] | None:
    """Return the files of a bag in sqlite3, in playing order; None for anything else."""
    if path.is_file():
        return [path] if _is_sqlite(path) else None
    named = {unpacked_name(file): file for end in (*PACKED, '')
             for file in path.glob(f'*.db3{end}')}
    found = list(filter(_is_sqlite, sorted(named.values(), key=natural)))
    if not any(path.glob('*.mcap*')):
        return found or None
    if found and not (path / FILE_NAME).exists():  # which says what belongs to the bag
        raise RecordingError(
            f'{escaped(path)}: holds .mcap files and {listing([file.name for file in found])}, '
            'which are no parts of one bag; give the files one by one, or move those of a bag '
            'into a folder of its own')
    return None


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
        start = _start(file)
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


def _is_sqlite(path: Path) -> bool:
    return _start(path).startswith(SQLITE)


def _start(path: Path) -> bytes:
    """Return how a file begins, unpacked; nothing of what is no file."""
    try:
        if path.is_file():  # opening a FIFO would wait for its writer
            with open(path, 'rb') as stream:
                start = stream.read(16)
                if not start.startswith(zstandard.FRAME_HEADER):
                    return start
                stream.seek(0)
                return zstandard.ZstdDecompressor().stream_reader(stream).read(16)
    except (OSError, zstandard.ZstdError):
        pass  # who reads it says why
    return b''
