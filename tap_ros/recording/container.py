# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, read front to back, block by block, as fast as they unpack.

A block is an unpacked chunk with a table of its messages; their bytes stay where they are. Nothing
but complete records is used, so what a killed recorder left is read too.
"""

from dataclasses import dataclass
import mmap
import struct
import zlib

import numpy as np
from tap_ros.errors import RecordingError
from tap_ros.recording.chunks import unpack

MAGIC = b'\x89MCAP0\r\n'
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _DATA_END = 3, 4, 5, 6, 7, 15
_RECORD = struct.Struct('<BQ')
_MESSAGE_HEAD = np.dtype([
    ('kind', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'), ('log', '<u8'),
    ('publish', '<u8')])
_HEAD_BYTES = _MESSAGE_HEAD.itemsize
_INDEX_START = 6  # bytes before the entries of a message index: channel, size of the entries
_RUN_BYTES = 2**20  # of messages outside of chunks that are taken together
_FOOTER = struct.Struct('<BQQQI')  # record header, summary start, summary offsets start, crc


@dataclass(frozen=True)
class Channel:
    """A topic in a file."""

    topic: str
    type_name: str
    encoding: str  # of messages; 'cdr' is all we read
    schema_encoding: str  # 'ros2msg' when schema is the text of the definition
    schema: str


@dataclass(frozen=True)
class Block:
    """Messages that lie in one buffer."""

    buffer: np.ndarray  # uint8
    messages: dict  # topic -> (N, 3) int64: log time (ns), start and size of the data


class McapFile:
    """
    An MCAP file to be read once from front to back.

    :param path: of the file.
    :raises RecordingError: when it is missing, empty or not MCAP.
    """

    def __init__(self, path):
        self.path = path
        self.channels = {}  # id -> Channel; grows while blocks are read
        self.damage = ''  # why the file could not be read to its end
        self._schemas = {}
        try:
            with open(path, 'rb') as stream:
                size = stream.seek(0, 2)
                if size == 0:
                    raise RecordingError(f'{path}: the file is empty')
                self.data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
        if self.data[:8] != MAGIC:
            raise RecordingError(
                f'{path}: not an MCAP file: it starts with {self.data[:8].hex(" ")}, '
                f'not {MAGIC.hex(" ")}')

    def topics(self):
        """
        Return what the file holds.

        Takes it from the summary; a file that has none is read through.

        :return: dict topic -> Channel.
        """
        if not self._read_summary():
            for _ in self.blocks(()):
                pass
        return {channel.topic: channel for channel in self.channels.values()}

    def blocks(self, wanted):
        """
        Yield the messages of some topics, block by block, in the order of the file.

        A block is good until the next one is asked for: buffers are used again, because fresh
        memory costs as much as unpacking into it.

        When the file ends too early all complete chunks are yielded, and `damage` says so.

        :param wanted: the topics.
        :raises RecordingError: for a damaged chunk.
        """
        buffer = np.empty(0, np.uint8)
        for kind, start, end, index in self._records():
            if kind == _CHUNK:
                where = f'{self.path}: chunk at byte {start}'
                data, buffer = unpack(memoryview(self.data)[start:end], where, buffer)
            else:
                data = np.frombuffer(self.data, np.uint8, end - start, start)
            yield self._block(data, index, wanted)

    def _read_summary(self):
        """Note the topics that the summary lists; tell whether there is a sound one."""
        data = memoryview(self.data)
        footer = len(data) - _FOOTER.size - len(MAGIC)
        if footer < len(MAGIC) or data[-len(MAGIC):] != MAGIC:
            return False
        kind, _, start, _, crc = _FOOTER.unpack_from(data, footer)
        if kind != 2 or not len(MAGIC) < start <= footer:
            return False
        if crc and zlib.crc32(data[start:footer + _FOOTER.size - 4]) != crc:
            return False
        while start + _RECORD.size <= footer:
            kind, length = _RECORD.unpack_from(data, start)
            if kind in (_SCHEMA, _CHANNEL):
                self._define(kind, data[start + _RECORD.size:start + _RECORD.size + length])
            start += _RECORD.size + length
        return bool(self.channels) and all(c.type_name for c in self.channels.values())

    def _records(self):
        """Yield (opcode, start, end, index) of chunks and of runs of messages outside of them."""
        position, size, run, chunk = len(MAGIC), len(self.data), None, None
        while True:
            complete = position + _RECORD.size <= size
            kind, length = _RECORD.unpack_from(self.data, position) if complete else (None, 0)
            start, end = position + _RECORD.size, position + _RECORD.size + length
            complete = complete and end <= size and kind != 0  # zeros: what was never written
            if chunk and (not complete or kind != _MESSAGE_INDEX):
                yield chunk
                chunk = None
            if run is not None and (not complete or kind != _MESSAGE or end - run > _RUN_BYTES):
                yield _MESSAGE, run, position, []
                run = None
            if not complete:
                self.damage = (
                    f'the file is cut off at byte {position} of {size}; '
                    'all that was written completely before is used')
                return
            if kind == _DATA_END:
                return
            if kind == _MESSAGE and run is None:
                run = position
            elif kind in (_SCHEMA, _CHANNEL):
                self._define(kind, memoryview(self.data)[start:end])
            elif kind == _CHUNK:
                chunk = (kind, start, end, [])
            elif kind == _MESSAGE_INDEX and chunk and length >= _INDEX_START + 16:
                chunk[3].append((start, length))
            position = end

    def _block(self, buffer, index, wanted):
        """Make the tables of the messages in a buffer, and note the topics defined in it."""
        positions = self._positions(buffer, index)
        heads = _heads(buffer, positions)
        sizes = heads['length'].astype(np.int64) - _HEAD_BYTES + _RECORD.size
        if sizes.min(initial=0) < 0:
            raise RecordingError(f'{self.path}: damaged record in a chunk: too short')
        table = np.stack([heads['log'].astype(np.int64), positions + _HEAD_BYTES, sizes], 1)
        found = {}
        for number in set(heads['channel'].tolist()):
            channel = self.channels.get(number)
            if channel is None or channel.topic not in wanted:
                continue
            if channel.encoding != 'cdr':
                raise RecordingError(
                    f'{self.path}: topic {channel.topic} is encoded as {channel.encoding!r}; '
                    'only cdr can be read')
            found.setdefault(channel.topic, []).append(np.flatnonzero(heads['channel'] == number))
        return Block(buffer, {
            topic: table[rows[0] if len(rows) == 1 else np.sort(np.concatenate(rows))]
            for topic, rows in found.items()})

    def _positions(self, buffer, index):
        """
        Return where the message records of a buffer start, (N,) int64.

        The index of the chunk says so; only what it does not cover is walked over. An index that
        does not fit is of no use: then everything is.
        """
        if index:
            try:
                return self._indexed(buffer, index)
            except RecordingError:
                pass  # a wrong index
        return self._walk(buffer, 0, len(buffer))

    def _indexed(self, buffer, index):
        """Return the same by an index; raise RecordingError when it is wrong."""
        size = len(buffer)
        entries = [
            np.frombuffer(self.data, '<u8', (length - _INDEX_START) // 8, start + _INDEX_START)
            for start, length in index]
        positions = np.sort(np.concatenate([e[1::2] for e in entries]).astype(np.int64))
        if positions[0] < 0 or positions[-1] > size - _HEAD_BYTES:
            raise RecordingError(f'{self.path}: an index points out of its chunk')
        heads = _heads(buffer, positions)
        lengths = np.minimum(heads['length'], size).astype(np.int64)
        ends = np.concatenate([[0], positions + _RECORD.size + lengths])
        starts = np.append(positions, size)
        if (starts < ends).any() or (heads['kind'] != _MESSAGE).any():
            raise RecordingError(f'{self.path}: an index does not point to messages')
        gaps = np.flatnonzero(starts != ends)
        more = [self._walk(buffer, int(ends[i]), int(starts[i])) for i in gaps]
        return np.sort(np.concatenate([positions, *more])) if more else positions

    def _walk(self, buffer, position, end):
        """Go over records one by one; note topics and return where messages start, (N,) int64."""
        found, data = [], memoryview(buffer)
        try:
            while position < end:
                kind, length = _RECORD.unpack_from(data, position)
                if kind == _MESSAGE:
                    found.append(position)
                elif kind in (_SCHEMA, _CHANNEL):
                    self._define(kind, data[position + 9:position + 9 + length])
                position += _RECORD.size + length
        except struct.error as error:
            raise RecordingError(f'{self.path}: damaged record in a chunk: {error}') from error
        if position != end or (found and found[-1] + _HEAD_BYTES > end):
            raise RecordingError(f'{self.path}: damaged record in a chunk: wrong length')
        return np.array(found, np.int64)

    def _define(self, kind, record):
        """Read a schema or channel record."""
        try:
            if kind == _SCHEMA:
                (number,) = struct.unpack_from('<H', record)
                name, position = _text(record, 2)
                encoding, position = _text(record, position)
                schema, _ = _text(record, position)
                self._schemas[number] = (name, encoding, schema)
                return
            number, schema = struct.unpack_from('<HH', record)
            topic, position = _text(record, 4)
            encoding, _ = _text(record, position)
        except (struct.error, UnicodeDecodeError) as error:
            raise RecordingError(f'{self.path}: damaged topic record: {error}') from error
        name, *about = self._schemas.get(schema, ('', '', ''))
        self.channels[number] = Channel(topic, name, encoding, *about)


def gather(buffer, starts, width):
    """
    Copy out equally long pieces of a buffer.

    :param buffer: uint8.
    :param starts: (N,) where the pieces start.
    :param width: of a piece.
    :return: (N, width) uint8.
    """
    return np.ndarray((len(buffer) - width + 1, width), np.uint8, buffer, 0, (1, 1))[starts]


def _heads(buffer, positions):
    """Return the first bytes of message records, (N,) of _MESSAGE_HEAD."""
    if not len(positions):
        return np.empty(0, _MESSAGE_HEAD)
    return gather(buffer, positions, _HEAD_BYTES).view(_MESSAGE_HEAD)[:, 0]


def _text(record, position):
    (length,) = struct.unpack_from('<I', record, position)
    position += 4
    return bytes(record[position:position + length]).decode(), position + length
