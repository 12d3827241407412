# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, read front to back past damage, by the records of the mcap package.

mcap's own readers end at the first record that they do not understand, skip what is cut short and
unpack what a file claims. Here chunks are read where the summary lists them; without a summary the
records are read one after the other, so that all that a killed recorder wrote completely is used.
What cannot be used is noted as a loss.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from pathlib import Path
import struct
from typing import TypeVar
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, ChunkIndex, McapRecord, MessageIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC
from tap_ros.errors import RecordingError
from tap_ros.recording.damage import FAR, Loss
from tap_ros.recording.file_bytes import bytes_of, what_else
from tap_ros.text import escaped
import zstandard

MAX_CHUNK_BYTES = 2**28  # a chunk that claims to unpack to more is refused
OTHERS = 0x80  # opcodes from here on belong to others, and are skipped
RECORD = struct.Struct('<BQ')  # opcode, length of what follows
_MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log time, publish time
_FOOTER = struct.Struct('<BQQQI')  # opcode, length, summary start, summary offsets start, crc
_TOPICS: dict[int, type[Schema | ChannelRecord]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: ChannelRecord}
_DAMAGE = (McapError, struct.error, ValueError, OverflowError)  # mcap's, for damaged bytes
Record = TypeVar('Record', bound=McapRecord)
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
    An MCAP file to be read once from front to back.

    :param path: of the file.
    :ivar channels: by number; grows while messages are read.
    :ivar losses: what could not be used; complete when all messages are read.
    :ivar size: bytes of the file.
    :raises RecordingError: when it is missing, empty, no regular file, or not MCAP.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self._map = bytes_of(path)
        if self._map[:len(MAGIC)] != MAGIC:
            why = what_else(Path(path)) or (
                f'not an MCAP file: it starts with {self._map[:8].hex(" ")}, not {MAGIC.hex(" ")}')
            raise RecordingError(f'{path}: {why}')
        self._data, self.size = memoryview(self._map), len(self._map)
        self.channels: dict[int, Channel] = {}
        self.losses: list[Loss] = []
        self._schemas: dict[int, Schema] = {}
        self._pending: list[tuple[str, str, int]] = []  # losses before the next message
        self._newest: int | None = None  # log time so far
        self._counts: Counter[int] = Counter()  # messages read by channel
        self._is_read = False  # to the end
        self._end, self._is_without_summary = self.size, False  # of the data
        self._stopped: int | None = None  # the byte from which on records are not understood
        self._summary = self._find_summary()
        for schema in self._summary.schemas.values():
            self._define(schema)
        for channel in self._summary.channels.values():
            self._define(channel)
        if not all(known.type_name for known in self.channels.values()):
            self.channels = {}  # the summary has channels without their types

    def topics(self) -> dict[str, Channel]:
        """
        Return what the file holds, by topic.

        Takes it from the summary; a file that has none is read through.
        """
        if not self.channels:
            for _ in self.messages(()):
                pass
        return {channel.topic: channel for channel in self.channels.values()}

    def counts(self) -> Counter[tuple[str, str]]:
        """Return the number of messages by topic and type; empty where nothing tells it."""
        found, statistics = Counter[tuple[str, str]](), self._summary.statistics
        counts = statistics.channel_message_counts if statistics else self._counts
        for number, channel in self.channels.items() if statistics or self._is_read else ():
            found[channel.topic, channel.type_name] += counts.get(number, 0)
        return found

    def messages(self, wanted: Collection[str]) -> Iterator[tuple[Channel, int, int, memoryview]]:
        """
        Yield the messages of some topics in the order of the file.

        What cannot be read is left out, chunk by chunk; `losses` says what it is.

        :param wanted: the topics.
        :return: iterator over (channel, log time and publish time in ns, data).
        """
        for number, log, publish, data in chain.from_iterable(self._blocks()):
            channel = self.channels.get(number)
            if channel is None or channel.topic not in wanted:
                continue
            yield channel, min(log, FAR), min(publish, FAR), data
        self._conclude(wanted)
        self._is_read = True

    def _blocks(self) -> Iterator[list[Found]]:
        """Yield the messages of the file, block by block."""
        indexed = bool(self._summary.chunk_indexes and self.channels)
        for found in self._indexed() if indexed else self._one_by_one():
            self._take_notice(found)
            yield found

    def _find_summary(self) -> Summary:
        """Return what the end of the file says it holds; nothing, where that cannot be used."""
        footer = self.size - _FOOTER.size - len(MAGIC)
        if footer < len(MAGIC) or self._data[-len(MAGIC):] != MAGIC:
            return Summary()
        kind, length, start, _, crc = _FOOTER.unpack_from(self._data, footer)
        if (kind, length) != (Opcode.FOOTER, _FOOTER.size - RECORD.size):
            return Summary()
        self._is_without_summary = start == 0
        if len(MAGIC) < start <= footer and (
                not crc or zlib.crc32(self._data[start:-len(MAGIC) - 4]) == crc):
            with suppress(*_DAMAGE):
                found = _read_summary(self._data[start:])
                self._end = start
                return found
        return Summary()

    def _indexed(self) -> Iterator[list[Found]]:
        """Yield the messages of the chunks that the summary lists."""
        entries = {entry.chunk_start_offset: entry for entry in self._summary.chunk_indexes}
        for offset, entry in sorted(entries.items()):
            try:
                found = self._read_chunk(offset, offset + entry.chunk_length, entry)
            except RecordingError as error:
                times = entry.message_start_time, entry.message_end_time
                self.losses.append(
                    Loss(str(error), 'chunk', offset, *(min(time, FAR) for time in times)))
                continue
            yield found

    def _one_by_one(self) -> Iterator[list[Found]]:
        """Yield the messages of one record after the other."""
        for kind, start, end in self._walk():
            found: list[Found] = []
            try:
                if kind == Opcode.CHUNK:
                    found = self._read_chunk(start, end)
                elif kind == Opcode.MESSAGE or kind in _TOPICS:
                    found = self._scan(self._data[start:end])
                elif kind == Opcode.MESSAGE_INDEX:  # a damaged chunk may look like one
                    read_record(MessageIndex, self._data[start + RECORD.size:end])
                elif kind < OTHERS and kind not in (
                        Opcode.HEADER, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END):
                    raise RecordingError('it is not understood')
            except RecordingError as error:
                what = 'chunk' if kind == Opcode.CHUNK else 'record'
                self._pending.append((str(error), what, start))
            yield found

    def _walk(self) -> Iterator[tuple[int, int, int]]:
        """Yield (opcode, start, end) of the records before the summary; note where they stop."""
        position = len(MAGIC)
        while position + RECORD.size <= self._end:
            kind, length = RECORD.unpack_from(self._data, position)
            end = position + RECORD.size + length
            if kind == 0 or end > self._end:  # zeros were never written
                break
            yield kind, position, end
            position = end
            if kind == Opcode.DATA_END and length == 4:
                return
        self._stopped = position

    def _read_chunk(self, start: int, end: int, entry: ChunkIndex | None = None) -> list[Found]:
        """
        Return the messages of a chunk.

        :param start: of its record, whose own header is not believed.
        :param end: of its record.
        :param entry: what the summary says of it.
        :raises RecordingError: when its checksum is wrong, or it is not whole.
        """
        if not len(MAGIC) <= start <= end - RECORD.size <= self._end - RECORD.size:
            raise RecordingError('it is not where the summary says')
        if end - start > MAX_CHUNK_BYTES:
            raise RecordingError(
                f'it has {end - start} bytes; at most {MAX_CHUNK_BYTES} are accepted')
        chunk = read_record(Chunk, self._data[start + RECORD.size:end], whole=False)
        size = chunk.uncompressed_size
        if entry and size != entry.uncompressed_size:
            raise RecordingError('it is not where the summary says')
        if size > MAX_CHUNK_BYTES:
            raise RecordingError(f'it claims to unpack to {size} bytes; at most '
                                 f'{MAX_CHUNK_BYTES} are accepted')
        try:
            data = _unpack(chunk.compression, chunk.data, size)
        except (zstandard.ZstdError, RuntimeError) as error:
            raise RecordingError(f'it does not unpack: {error}') from error
        crc = chunk.uncompressed_crc
        if len(data) != size or (crc and zlib.crc32(data) != crc):
            raise RecordingError('its checksum or size is wrong; restore the file from a copy')
        return self._scan(memoryview(data))

    def _scan(self, data: memoryview) -> list[Found]:
        """
        Return the messages among records; take notice of topics.

        :raises RecordingError: for what is damaged or cut off.
        """
        found: list[Found] = []
        position = 0
        try:
            while position < len(data):
                kind, length = RECORD.unpack_from(data, position)
                end = position + RECORD.size + length
                if kind == Opcode.MESSAGE:
                    _, _, number, _, log, publish = _MESSAGE.unpack_from(data, position)
                    if position + _MESSAGE.size > end:
                        raise RecordingError('it holds a damaged record: too short')
                    found.append((number, log, publish, data[position + _MESSAGE.size:end]))
                elif kind in _TOPICS:
                    self._define(read_record(_TOPICS[kind], data[position + RECORD.size:end]))
                elif kind < OTHERS:
                    raise RecordingError(f'it holds a damaged record: opcode {kind}')
                position = end
        except struct.error as error:
            raise RecordingError('it holds a damaged record: cut off') from error
        if position != len(data):
            raise RecordingError('it holds a damaged record: wrong length')
        return found

    def _define(self, record: Schema | ChannelRecord) -> None:
        """Take notice of a schema or channel; the first of a number holds."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif record.id not in self.channels:
            schema = self._schemas.get(record.schema_id, Schema(0, b'', '', ''))
            self.channels[record.id] = Channel(
                record.topic, schema.name, record.message_encoding, schema.encoding,
                schema.data.decode(errors='replace'))

    def _take_notice(self, found: list[Found]) -> None:
        """Count messages; what was lost before them ends with the first."""
        if not found:
            return
        self._counts.update(number for number, *_ in found)
        times = [min(log, FAR) for _, log, *_ in found]
        first, last = min(times), max(times)
        start = first if self._newest is None else min(self._newest, first)
        self.losses += [Loss(*loss, start, first) for loss in self._pending]
        self._pending = []
        self._newest = last if self._newest is None else max(last, self._newest)
        for number in {number for number, *_ in found} - self.channels.keys():
            logs = [log for log, message in zip(times, found) if message[0] == number]
            self.losses.append(Loss(f'messages of channel {number}, which nothing describes',
                                    'block', None, min(logs), max(logs)))

    def _conclude(self, wanted: Collection[str]) -> None:
        """Compare what was read with what the end of the file says."""
        is_whole, end = self._end < self.size, self._newest
        if self._stopped is not None and is_whole:
            self._pending.append(('it is not understood', 'record', self._stopped))
        self.losses += [Loss(*loss, end, end) for loss in self._pending]
        self._pending = []
        statistics = self._summary.statistics
        missing = {number: count for number, count in (
            statistics.channel_message_counts if statistics else {}).items()
            if count > self._counts[number]}
        if statistics and not missing:  # what was skipped held no message
            self.losses = [loss for loss in self.losses if loss.what != 'record']
        lines = [
            f'{count - self._counts[number]} of {count} of topic '
            f'{escaped(self.channels[number].topic)}' for number, count in missing.items()
            if number in self.channels and self.channels[number].topic in wanted]
        if lines:
            self.losses.append(Loss(f'messages are missing: {", ".join(lines)}', cuts=False))
        if self._stopped is not None and not is_whole:
            self.losses.append(Loss(
                f'the file is cut off at byte {self._stopped} of {self.size}; '
                'what is whole before that is used; copy it again if it was cut by copying',
                start=None if end is None else end + 1, end=end))
        elif not is_whole and not self._is_without_summary:
            self.losses.append(Loss('its summary is damaged, so that nothing tells whether all '
                                    'messages are there', cuts=False))


def read_record(kind: type[Record], content: bytes | memoryview, whole: bool = True) -> Record:
    """
    Read the content of a record.

    :param kind: the class in mcap.records.
    :param content: bytes-like.
    :param whole: whether nothing may stand behind what is read.
    :raises RecordingError: when it is damaged.
    """
    stream = ReadDataStream(BytesIO(content))
    try:
        record: Record = kind.read(stream)  # type: ignore[attr-defined]  # of each, not of all
    except _DAMAGE as error:
        raise RecordingError(f'damaged {kind.__name__.lower()} record') from error
    if whole and stream.count != len(content):
        raise RecordingError(f'damaged {kind.__name__.lower()} record: wrong length')
    return record


def _read_summary(data: memoryview) -> Summary:
    """Read a summary, from its first record to the end of the file; raise one of _DAMAGE."""
    summary = Summary()
    for record in StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records:
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            summary.channels[record.id] = record
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, Statistics):
            summary.statistics = record
    return summary


def _unpack(compression: str, data: bytes | memoryview, size: int) -> bytes | memoryview:
    """Unpack the data of a chunk, which never takes more memory than it claims."""
    if compression == '':
        return data
    if compression == 'zstd':
        # What the frame says about its size counts more for the decompressor than our limit.
        if zstandard.frame_content_size(data) not in (-1, size):
            raise RecordingError('it unpacks to more than it claims, or to less')
        return zstandard.ZstdDecompressor().decompress(data, size)
    if compression == 'lz4':
        import lz4.frame  # comes with mcap; few recordings need it
        return lz4.frame.LZ4FrameDecompressor().decompress(data, size)
    raise RecordingError(
        f'it is compressed as {compression[:40]!r}; zstd, lz4 and none can be read')
