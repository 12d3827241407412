# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, read front to back, block by block, as fast as they unpack.

A block is an unpacked chunk with a table of its messages; chunks are unpacked and checked ahead
in threads. Nothing but complete records is used, so what a killed recorder left is read too.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
import mmap
import struct
import threading
import zlib

import numpy as np
import zstandard

from tap_ros.errors import RecordingError

MAGIC = b'\x89MCAP0\r\n'
MAX_CHUNK_BYTES = 256 * 2**20  # a chunk that claims to unpack to more is refused
THREADS = 2
_AHEAD = 4  # chunks unpacked ahead of their use
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 3, 4, 5, 6, 15
_RECORD = struct.Struct('<BQ')
_MESSAGE_START = struct.Struct('<BQHIQQ')  # record header, channel, sequence, log and publish time
_CHUNK_START = struct.Struct('<QQQII')  # start, end, unpacked size, crc, length of compression
_FOOTER = struct.Struct('<BQQQI')  # record header, summary start, summary offsets start, crc
_local = threading.local()


@dataclass(frozen=True)
class Channel:
    """A topic in a file."""

    topic: str
    type_name: str
    encoding: str  # of messages; 'cdr' is all we read
    schema_encoding: str


@dataclass(frozen=True)
class Block:
    """Messages that lie in one buffer, in the order of the file."""

    buffer: np.ndarray  # uint8
    channels: np.ndarray  # (N,) int64, keys of McapFile.channels
    log_times: np.ndarray  # (N,) int64, nanoseconds
    starts: np.ndarray  # (N,) int64, where the data of the message starts in the buffer
    sizes: np.ndarray  # (N,) int64


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
            for _ in self.blocks():
                pass
        return {channel.topic: channel for channel in self.channels.values()}

    def blocks(self):
        """
        Yield all messages, block by block.

        When the file ends too early all complete chunks are yielded, and `damage` says so.

        :raises RecordingError: for a chunk whose checksum is wrong, that does not unpack, or that
            claims to unpack to more than MAX_CHUNK_BYTES.
        """
        waiting = deque()
        with ThreadPoolExecutor(THREADS) as pool:
            for kind, start, end in self._records():
                if kind == _CHUNK:
                    waiting.append(pool.submit(self._unpack, start, end))
                elif kind == _MESSAGE:
                    waiting.append(pool.submit(self._take, start - _RECORD.size, end))
                if len(waiting) > _AHEAD:
                    yield self._block(waiting.popleft().result())
            while waiting:
                yield self._block(waiting.popleft().result())

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
        return bool(self.channels)

    def _records(self):
        """Yield (opcode, start, end) of chunks, and of runs of messages outside of chunks."""
        position, size, run = len(MAGIC), len(self.data), None
        while True:
            complete = position + _RECORD.size <= size
            kind, length = _RECORD.unpack_from(self.data, position) if complete else (None, 0)
            start, end = position + _RECORD.size, position + _RECORD.size + length
            complete = complete and end <= size
            if run is not None and (
                    not complete or kind != _MESSAGE or end - run > 2**20):
                yield _MESSAGE, run + _RECORD.size, position
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
                yield kind, start, end
            position = end

    def _take(self, start, end):
        return np.frombuffer(self.data, np.uint8, end - start, start)

    def _unpack(self, start, end):
        """Unpack and check one chunk; runs in a thread."""
        where = f'{self.path}: chunk at byte {start}'
        view = memoryview(self.data)[start:end]
        try:
            _, _, size, crc, length = _CHUNK_START.unpack_from(view)
            compression = bytes(view[_CHUNK_START.size:_CHUNK_START.size + length]).decode()
            (packed,) = struct.unpack_from('<Q', view, _CHUNK_START.size + length)
        except (struct.error, UnicodeDecodeError) as error:
            raise RecordingError(f'{where} is damaged: {error}') from error
        body = view[_CHUNK_START.size + length + 8:]
        if len(body) != packed:
            raise RecordingError(f'{where} is damaged: it has {len(body)} of {packed} bytes')
        if size > MAX_CHUNK_BYTES:
            raise RecordingError(
                f'{where} claims to unpack to {size} bytes; at most {MAX_CHUNK_BYTES} are accepted')
        data = _decompress(compression, body, size, where)
        if len(data) != size or (crc and zlib.crc32(data) != crc):
            raise RecordingError(
                f'{where} is damaged: its checksum or size is wrong; restore the file from a copy')
        return np.frombuffer(data, np.uint8)

    def _block(self, buffer):
        """Make the table of the messages in a buffer, and note the topics defined in it."""
        rows, position, size = [], 0, len(buffer)
        data = memoryview(buffer)
        unpack, header = _MESSAGE_START.unpack_from, _MESSAGE_START.size
        try:
            while position < size:
                kind, length = data[position], 0
                if kind == _MESSAGE:
                    _, length, channel, _, log, _ = unpack(data, position)
                    rows.append((channel, log, position + header, length - 22))
                else:
                    kind, length = _RECORD.unpack_from(data, position)
                    start = position + _RECORD.size
                    if kind in (_SCHEMA, _CHANNEL):
                        self._define(kind, data[start:start + length])
                position += _RECORD.size + length
            table = np.array(rows, np.int64).reshape(-1, 4).T
        except (struct.error, OverflowError) as error:
            raise RecordingError(f'{self.path}: damaged record in a chunk: {error}') from error
        if position != size or (table[3] < 0).any():
            raise RecordingError(f'{self.path}: damaged record in a chunk: wrong length')
        return Block(buffer, *table)

    def _define(self, kind, record):
        """Read a schema or channel record."""
        try:
            if kind == _SCHEMA:
                (number,) = struct.unpack_from('<H', record)
                name, position = _text(record, 2)
                encoding, _ = _text(record, position)
                self._schemas[number] = (name, encoding)
                return
            number, schema = struct.unpack_from('<HH', record)
            topic, position = _text(record, 4)
            encoding, _ = _text(record, position)
        except (struct.error, UnicodeDecodeError) as error:
            raise RecordingError(f'{self.path}: damaged topic record: {error}') from error
        name, schema_encoding = self._schemas.get(schema, ('', ''))
        self.channels[number] = Channel(topic, name, encoding, schema_encoding)


def _text(record, position):
    (length,) = struct.unpack_from('<I', record, position)
    position += 4
    return bytes(record[position:position + length]).decode(), position + length


def _decompress(compression, body, size, where):
    """Return the unpacked bytes of a chunk, never more than it claims."""
    if compression == '':
        return body
    try:
        if compression == 'zstd':
            if zstandard.frame_content_size(body) > size:
                raise RecordingError(f'{where} is damaged: it unpacks to more than it claims')
            if not hasattr(_local, 'zstd'):
                _local.zstd = zstandard.ZstdDecompressor()
            return _local.zstd.decompress(body, max_output_size=size)
        if compression == 'lz4':
            import lz4.frame  # comes with mcap; few recordings need it
            return lz4.frame.LZ4FrameDecompressor().decompress(body, max_length=size)
    except (zstandard.ZstdError, RuntimeError) as error:
        raise RecordingError(f'{where} does not unpack: {error}') from error
    raise RecordingError(
        f'{where} is compressed as {compression!r}; zstd, lz4 and none can be read')
