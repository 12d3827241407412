# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Bags that are not MCAP: of ROS 1, and those that ROS 2 keeps in sqlite3.

They are read front to back and need no index and no metadata, which killed recorders do not
leave behind.
"""

import bz2
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
import mmap
from pathlib import Path
import sqlite3
import struct

from mcap.summary import Summary
from tap_ros.errors import RecordingError
from tap_ros.recording.channels import Channel, converted
from tap_ros.recording.copies import readable
from tap_ros.recording.damage import FAR, Loss
from tap_ros.recording.mcap_file import Found, McapFile
from tap_ros.text import escaped

_MAGIC = b'#ROSBAG V2.0\n'
_MESSAGE, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 5, 6, 7  # kinds of records
_INT, _LONG = struct.Struct('<I'), struct.Struct('<Q')
Header = dict[bytes, bytes]


class OtherBag(McapFile):
    """What reading such bags has in common: all that McapFile does with what is found."""

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.losses: list[Loss] = []
        self._counts = Counter[int]()
        self._summary, self._is_read = Summary(), True  # the number of messages is known
        self._newest: int | None = None
        try:
            self._describe(readable(Path(path)))
        except (OSError, sqlite3.Error, struct.error, LookupError, ValueError) as error:
            way = '; copy it again' if isinstance(error, sqlite3.DatabaseError) else ''
            raise RecordingError(
                f'{escaped(path)}: cannot be read: {escaped(error)}{way}') from error

    def _blocks(self) -> Iterator[list[Found]]:
        for found in self._messages():
            self._newest = min(found[1], FAR)
            yield [found]

    def _conclude(self, wanted: Collection[str]) -> None:
        """Leave it to what _messages said."""

    def _lose(self, why: str) -> None:
        """Note that all behind the newest message is lost."""
        behind = None if self._newest is None else self._newest + 1
        self.losses.append(Loss(why, start=behind, end=self._newest))

    def _describe(self, path: Path) -> None:
        """Learn of the channels, and how many messages each has."""
        raise NotImplementedError

    def _messages(self) -> Iterator[Found]:
        """Yield the messages in the order of the file, and note what is lost."""
        raise NotImplementedError


class SqliteFile(OtherBag):
    """A file of a bag that ROS 2 keeps in sqlite3."""

    def _describe(self, path: Path) -> None:
        self._whole = path
        with closing(self._open()) as base:
            texts = dict[str, str]()
            with suppress(sqlite3.Error):  # bags before Iron have none
                texts = dict(base.execute(
                    'SELECT topic_type, encoded_message_definition FROM message_definitions '
                    "WHERE encoding = 'ros2msg'"))
            for number, topic, kind, encoding in base.execute(
                    'SELECT id, name, type, serialization_format FROM topics'):
                text = texts.get(kind, '')
                self.channels[number] = converted(Channel(
                    topic, kind, encoding, 'ros2msg' if text else '', text))
            self._counts.update(dict(base.execute(
                'SELECT topic_id, count(*) FROM messages GROUP BY topic_id')))

    def _messages(self) -> Iterator[Found]:
        try:
            with closing(self._open()) as base:
                for number, log, data in base.execute(
                        'SELECT topic_id, timestamp, data FROM messages ORDER BY id'):
                    if number in self.channels:
                        yield number, log, log, memoryview(data)
        except sqlite3.Error as error:
            self._lose(f'all behind is lost: {escaped(error)}')

    def _open(self) -> sqlite3.Connection:
        return sqlite3.connect(f'{self._whole.absolute().as_uri()}?immutable=1', uri=True)


class Ros1File(OtherBag):
    """A bag of ROS 1, with an index or without one."""

    def _describe(self, path: Path) -> None:
        with open(path, 'rb') as stream:
            self._data = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
        header = next((fields for fields, *_ in _records(self._data, len(_MAGIC))), {})
        index = _LONG.unpack(header.get(b'index_pos', bytes(8)))[0]
        is_whole = False
        for fields, content, end in _records(self._data, max(index, len(_MAGIC))) if index else ():
            is_whole = end == len(self._data)
            if fields[b'op'][0] == _CONNECTION:
                self._connect(fields, content)
            elif fields[b'op'][0] == _CHUNK_INFO:
                for number, count in struct.iter_unpack('<II', content):
                    self._counts[number] += count
        if not is_whole:  # its index is missing, or cut off
            self._counts = Counter(number for number, *_ in self._messages())

    def _messages(self) -> Iterator[Found]:
        end, self.losses = 0, []  # of what is whole; what is lost is met again
        for fields, content, end in _records(self._data, len(_MAGIC)):
            kind = fields[b'op'][0]
            if kind == _CHUNK:
                try:
                    unpacked = memoryview(_unpack(fields[b'compression'], content))
                except (OSError, EOFError, RuntimeError, RecordingError) as error:
                    self.losses.append(Loss(f'it does not unpack: {escaped(error)}', 'chunk', end,
                                            self._newest, self._newest))
                    continue
                for inner, content, _ in _records(unpacked, 0):
                    yield from self._take(inner, content)
            else:
                yield from self._take(fields, content)
        if end != len(self._data):
            self._lose(f'the file of {len(self._data)} bytes is cut off; what is whole before '
                       'that is used')

    def _take(self, fields: Header, content: memoryview) -> Iterator[Found]:
        """Yield what is in a record, if it is a message; take notice of connections."""
        if fields[b'op'][0] == _CONNECTION:
            self._connect(fields, content)
        elif fields[b'op'][0] == _MESSAGE:
            number = _INT.unpack(fields[b'conn'])[0]
            seconds, rest = struct.unpack('<II', fields[b'time'])
            log = seconds * 10**9 + rest
            if number in self.channels:
                yield number, log, log, content

    def _connect(self, fields: Header, content: memoryview) -> None:
        """Take notice of a connection; the first of a number holds."""
        number = _INT.unpack(fields[b'conn'])[0]
        if number not in self.channels:
            kind = _fields(content)[b'type'].decode(errors='replace')
            self.channels[number] = converted(Channel(
                fields[b'topic'].decode(errors='replace'), kind, 'ros1'))


def _records(data: memoryview, at: int) -> Iterator[tuple[Header, memoryview, int]]:
    """Yield header, data and end of records; a chunk may be cut off, and end behind the data."""
    while at + 4 <= len(data):
        try:
            end = at + 4 + _INT.unpack_from(data, at)[0]
            fields = _fields(data[at + 4:end])
            at = end + 4 + _INT.unpack_from(data, end)[0]
            is_chunk = fields[b'op'][0] == _CHUNK
        except (struct.error, LookupError, ValueError):
            return
        if at <= len(data) or is_chunk:
            yield fields, data[end + 4:at], at


def _fields(data: memoryview) -> Header:
    """Return the fields of a header by name."""
    found, at = {}, 0
    while at < len(data):
        end = at + 4 + _INT.unpack_from(data, at)[0]
        name, is_whole, value = bytes(data[at + 4:end]).partition(b'=')
        if not is_whole or end > len(data):
            raise ValueError('damaged header')
        found[name], at = value, end
    return found


def _unpack(compression: bytes, data: memoryview) -> bytes | memoryview:
    """Unpack a chunk, as far as it is there."""
    if compression == b'none':
        return data
    if compression == b'bz2':
        return bz2.BZ2Decompressor().decompress(data)
    if compression == b'lz4':
        import lz4.frame  # as in mcap_file
        return lz4.frame.LZ4FrameDecompressor().decompress(bytes(data))
    raise RecordingError(f'it is compressed as {escaped(compression, 40)}')
