# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, read front to back past damage, by the records of the mcap package.

mcap's own readers end at the first record that they do not understand. Here chunks are read where
the summary lists them; without a summary the records are read one after the other, so that all
that a killed recorder wrote completely is used. What cannot be used is noted as a defect.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from itertools import chain
import mmap
from pathlib import Path
import struct
from typing import Any
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, ChunkIndex, DataEnd, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC
from tap_ros.base.contract import MAX_PICTURE_BYTES
from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.recording.defects import Defect, FAR
from tap_ros.recording.raw_files import bytes_of
from tap_ros.recording.trust import Budget
import zstandard

MAX_CHUNK_BYTES = 2**28  # a chunk that claims to unpack to more is refused
_MAX_MESSAGE_BYTES = MAX_PICTURE_BYTES + 2**16  # of one that rosbag2 compressed
_MAX_SCHEMA_BYTES = 2**17  # that are kept of a definition; the longest in use have some thousands
_RECORD = struct.Struct('<BQ')  # opcode, length of what follows
_MESSAGE = struct.Struct('<HIQQ')  # channel, number, log and publish time; its data follow
_FOOTER = struct.Struct('<BQQQI')  # opcode, length, summary start, summary offsets start, crc
_DAMAGE = (McapError, struct.error, ValueError, OverflowError, RuntimeError, MemoryError,
           zstandard.ZstdError)  # of damaged bytes
Found = tuple[int, int, int, memoryview]  # number of the channel, log and publish time, data


@dataclass(frozen=True)
class Channel:
    """A topic in a file."""

    topic: str
    type_name: str
    encoding: str  # of messages; 'cdr' is all we read
    schema_encoding: str = ''  # 'ros2msg' when schema is the text of the definition
    schema: str = ''


class McapFile:
    """
    An MCAP file, opened once and read from front to back as often as is needed.

    :param path: of the file.
    :ivar channels: by number; grows while messages are read.
    :ivar summary: what the end of the file says that it holds; empty where that is damaged.
    :ivar defects: what could not be used; complete when all messages are read.
    :raises RecordingError: when it is missing, empty, no regular file, or not MCAP.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self._size = len(self._data)
        if self._data[:len(MAGIC)] != MAGIC:
            raise RecordingError(f'{path}: not an MCAP file: it starts with '
                                 f'{self._data[:8].hex(" ")}, not {MAGIC.hex(" ")}')
        self.channels: dict[int, Channel] = {}
        self.defects: list[Defect] = []
        self._schemas: dict[int, tuple[str, str, str]] = {}  # name, encoding, text
        self._newest: int | None = None  # log time so far
        self._counts: Counter[int] = Counter()  # messages read by channel
        self._is_read = False  # to the end
        self._needs_summary = True  # as its end says that there is one, or is not there
        self._stopped: int | None = None  # the byte from which on records are not understood
        self.summary = self._find_summary()
        self._scan([*self.summary.schemas.values(), *self.summary.channels.values()])
        if not self.channels or not all(one.type_name for one in self.channels.values()):
            self.channels, self.summary.chunk_indexes = {}, []  # the summary does not tell types
            for _ in self.messages(()):
                pass
        self.close()

    @cached_property
    def _data(self) -> bytes | mmap.mmap:
        return bytes_of(self.path)

    def close(self) -> None:
        """Let go of the bytes, of which there may be many; what is read next maps them again."""
        vars(self).pop('_data', None)

    def __getstate__(self) -> dict[str, Any]:
        """Let another process go on with what is known."""
        return {name: value for name, value in vars(self).items() if name != '_data'}

    def counts(self) -> dict[tuple[str, str], int | None]:
        """Return the number of messages by topic and type; None where nothing tells it."""
        statistics, found = self.summary.statistics, dict[tuple[str, str], int | None]()
        counts = statistics.channel_message_counts if statistics else self._counts
        for number, channel in self.channels.items():
            key = channel.topic, channel.type_name
            found[key] = (found.get(key) or 0) + counts.get(number, 0) if (
                statistics or self._is_read) else None
        return found

    def messages(self, wanted: Collection[str]) -> Iterator[tuple[Channel, int, int, memoryview]]:
        """
        Yield the messages of some topics in the order of the file.

        What cannot be read is left out, chunk by chunk; `defects` says what it is.

        :param wanted: the topics.
        :return: iterator over (channel, log time and publish time in ns, data).
        """
        self.defects, self._budget = [], Budget(self._size)
        self._newest = self._stopped = None
        for number, log, publish, data in chain.from_iterable(self._blocks()):
            channel = self.channels.get(number)
            if channel is None or channel.topic not in wanted:
                continue
            yield channel, min(log, FAR), min(publish, FAR), self._decompressed(data)
        self._conclude(wanted)
        self._is_read = True

    def at(self, topic: str, log: int) -> list[tuple[str, memoryview]]:
        """
        Return type and data of the messages of a topic that were logged at a time, in ns.

        Only the chunks of that time are unpacked. A file without an index has none.
        """
        self._budget = Budget(self._size)
        return [(channel.type_name, self._decompressed(data)) for number, time, _, data
                in chain.from_iterable(self._blocks_at(log)) if time == log
                and (channel := self.channels.get(number)) and channel.topic == topic]

    def _decompressed(self, data: memoryview) -> memoryview:
        """Return what rosbag2 compressed of a message; as it is, what it did not or is damaged."""
        if data[:4] == zstandard.FRAME_HEADER:
            with suppress(*_DAMAGE):  # who decodes it says that it is none
                told = zstandard.frame_content_size(data)
                most = _MAX_MESSAGE_BYTES if told < 0 else min(told, _MAX_MESSAGE_BYTES)
                self._budget.take(most)  # before it costs time
                content = _unpack('zstd', data, most + 1)
                self._budget.take(len(content) - most)
                if len(content) <= most:
                    return memoryview(content)
        return data

    def _blocks_at(self, log: int) -> Iterator[list[Found]]:
        """Yield the messages of the blocks that reach over a time."""
        for start, entry, behind in self._indexed():
            if entry.message_start_time <= log <= entry.message_end_time:
                yield self._unpacked(start, entry, behind)

    def _indexed(self) -> Iterator[tuple[int, ChunkIndex, int]]:
        """Yield where each chunk of the index is, in order, and where the next one begins."""
        entries = {entry.chunk_start_offset: entry for entry in self.summary.chunk_indexes}
        starts = sorted(entries)
        for start, behind in zip(starts, [*starts[1:], self._size]):
            yield start, entries[start], behind

    def _blocks(self) -> Iterator[list[Found]]:
        """Yield the messages of the file, block by block."""
        self._counts.clear()
        if self.summary.chunk_indexes:
            yield from (self._unpacked(*place) for place in self._indexed())
            return
        for start, record in self._in_order():
            yield self._unpacked(start, record) if isinstance(record, Chunk) else (
                self._scan([record]))
        if self._stopped is not None:
            yield self._scan(list(self._beginning_of_chunk(self._stopped)))

    def _find_summary(self) -> Summary:
        """Return what the end of the file says it holds; nothing, where that cannot be used."""
        summary, footer = Summary(), self._size - _FOOTER.size - len(MAGIC)
        if footer < len(MAGIC) or self._data[-len(MAGIC):] != MAGIC:
            return summary
        kind, length, start, _, crc = _FOOTER.unpack_from(self._data, footer)
        if (kind, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size):
            return summary
        self._needs_summary = start != 0
        if not len(MAGIC) < start <= footer or (
                crc and zlib.crc32(self._data[start:-len(MAGIC) - 4]) != crc):
            return summary
        with suppress(*_DAMAGE):
            for record in StreamReader(
                    BytesIO(self._data[start:]), skip_magic=True, emit_chunks=True).records:
                if isinstance(record, Schema):
                    summary.schemas[record.id] = record
                elif isinstance(record, ChannelRecord):
                    summary.channels[record.id] = record
                elif isinstance(record, ChunkIndex):
                    summary.chunk_indexes.append(record)
                elif isinstance(record, Statistics):
                    summary.statistics = record
            self._needs_summary = False
            return summary
        return Summary()

    def _in_order(self) -> Iterator[tuple[int, McapRecord]]:
        """Yield (byte, record) of the records before the summary; note where they stop."""
        stream: Any = self._data if isinstance(self._data, mmap.mmap) else BytesIO(self._data)
        stream.seek(0)
        records, start = StreamReader(stream, emit_chunks=True).records, len(MAGIC)
        with suppress(*_DAMAGE):
            for record in records:
                if isinstance(record, DataEnd):
                    return
                yield start, record
                start = stream.tell()
        self._stopped = start

    def _beginning_of_chunk(self, start: int) -> Iterator[McapRecord | Found]:
        """Yield the records that are whole in a chunk that the file ends in, at a byte."""
        with suppress(*_DAMAGE):
            stream = ReadDataStream(BytesIO(self._data[start:start + 100]))
            kind = stream.read1()
            stream.read(3 * 8)  # the length of the record, and the times
            size, _, name, _ = (stream.read8(), stream.read4(), stream.read_prefixed_string(),
                                stream.read8())
            if kind != Opcode.CHUNK or size > MAX_CHUNK_BYTES:
                return
            self._budget.take(size)
            yield from _split(
                _unpack(name, self._data[start + stream.count:], size), self._budget)

    def _unpacked(self, start: int, chunk: Chunk | ChunkIndex, behind: int = 0) -> list[Found]:
        """Return the messages of a chunk at a byte; its summary says where the next begins."""
        first, last = (min(time, FAR) for time in (
            chunk.message_start_time, chunk.message_end_time))
        try:
            if isinstance(chunk, ChunkIndex):  # the header of its record is not believed
                index, end = chunk, min(start + chunk.chunk_length, behind)
                content = self._data[start + _RECORD.size:end]
                chunk = Chunk.read(ReadDataStream(BytesIO(content)))
                if chunk.uncompressed_size != index.uncompressed_size:
                    raise ValueError('it is not where the summary says')
            if chunk.uncompressed_size > MAX_CHUNK_BYTES:
                raise ValueError(f'it claims to unpack to {chunk.uncompressed_size} bytes; at '
                                 f'most {MAX_CHUNK_BYTES} are accepted')
            self._budget.take(chunk.uncompressed_size)
            data = _unpack(chunk.compression, chunk.data, chunk.uncompressed_size + 1)
            if len(data) != chunk.uncompressed_size:
                raise ValueError('it unpacks to more than it claims, or to less')
            if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
                raise ValueError('its CRC does not match')
            return self._scan(list(_split(data, self._budget)))
        except _DAMAGE as error:
            self.defects.append(Defect(f'it is damaged, restore the file from a copy: {error}',
                                    'chunk', start, first, last))
            return []

    def _scan(self, records: Sequence[McapRecord | Found]) -> list[Found]:
        """Return the messages among records; take notice of topics, the first of a number."""
        found: list[Found] = []
        for record in records:
            if isinstance(record, tuple):
                found.append(record)
            elif isinstance(record, Message):
                found.append((record.channel_id, record.log_time, record.publish_time,
                              memoryview(record.data)))
            elif isinstance(record, Schema):
                self._schemas.setdefault(record.id, (  # once, as channels may share it
                    record.name, record.encoding,
                    record.data[:_MAX_SCHEMA_BYTES].decode(errors='replace')))
            elif isinstance(record, ChannelRecord) and record.id not in self.channels:
                name, encoding, text = self._schemas.get(record.schema_id, ('', '', ''))
                self.channels[record.id] = Channel(
                    record.topic, name, record.message_encoding, encoding, text)
        self._counts.update(number for number, *_ in found)
        if found:
            newest = min(max(log for _, log, *_ in found), FAR)
            self._newest = newest if self._newest is None else max(newest, self._newest)
        for number in {number for number, *_ in found} - self.channels.keys():
            logs = [min(log, FAR) for own, log, *_ in found if own == number]
            self.defects.append(Defect(f'messages of channel {number}, which nothing describes',
                                    'block', None, min(logs), max(logs)))
        return found

    def _conclude(self, wanted: Collection[str]) -> None:
        """Compare what was read with what the end of the file says."""
        statistics, end = self.summary.statistics, self._newest
        lines = [
            f'{count - self._counts[number]} of {count} of topic '
            f'{escaped(self.channels[number].topic)}' for number, count in (
                statistics.channel_message_counts if statistics else {}).items()
            if count > self._counts[number]
            and number in self.channels and self.channels[number].topic in wanted]
        if lines:
            self.defects.append(Defect(f'messages are missing: {", ".join(lines)}', cuts=False))
        if self._stopped is not None:
            self.defects.append(Defect(
                (f'the file is cut off at byte {self._stopped} of {self._size}'
                 if self._stopped < self._size else 'the file is cut off within a record, or is '
                 'being recorded') + '; what is whole before that is used; copy it again if it '
                'was cut by copying',
                start=None if end is None else end + 1, end=end))
        elif self._needs_summary:
            self.defects.append(Defect('its summary is damaged, so that nothing tells whether all '
                                    'messages are there', cuts=False))


def _unpack(compression: str, data: bytes | memoryview, most: int) -> bytes | memoryview:
    """Return at most so many of the bytes that were compressed."""
    if compression == 'zstd':
        return zstandard.ZstdDecompressor().stream_reader(data).read(most)
    if compression == 'lz4':
        import lz4.frame  # comes with mcap; few recordings need it
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, most))
    if compression:
        raise ValueError(f'it is compressed by {compression}')
    return data[:most]


def _split(data: bytes | memoryview, budget: Budget) -> Iterator[McapRecord | Found]:
    """Yield the records of a chunk that are read: messages, topics and their types."""
    at, view = 0, memoryview(data)
    while at < len(data):
        kind, length = _RECORD.unpack_from(data, at)
        start, at = at + _RECORD.size, at + _RECORD.size + length
        budget.take(0, 1)
        if not kind or at > len(data) or (kind == Opcode.MESSAGE and length < _MESSAGE.size):
            raise ValueError('its records are damaged')
        if kind == Opcode.MESSAGE:
            channel, _, log, publish = _MESSAGE.unpack_from(data, start)
            yield channel, log, publish, view[start + _MESSAGE.size:at]
        elif kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield (Schema if kind == Opcode.SCHEMA else ChannelRecord).read(
                ReadDataStream(BytesIO(view[start:at])))
