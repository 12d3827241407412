# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, read front to back, past damage.

Where the summary is whole, chunks are read where it says they are. Else the records are walked
over, so that what a killed recorder left is read, too. What cannot be used, or is not where the
summary says, is noted as a loss.
"""

from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
import mmap
import os
from pathlib import Path
import stat
import struct

from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema
from tap_ros.errors import RecordingError
from tap_ros.recording.chunks import read_chunk, read_record, unpack
from tap_ros.recording.damage import FAR, Loss, NOTHING
from tap_ros.recording.records import in_order, OTHERS, Records, TOPIC_RECORDS
from tap_ros.recording.summary import ChunkEntry, MAGIC, read_summary, RECORD
from tap_ros.text import escaped

# Bounds on what a file may unpack to, far above what recordings of its size hold.
FREE_BYTES, BYTES_PER_BYTE = 2**28, 1024
FREE_RECORDS, BYTES_PER_RECORD = 2**17, 4
_MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log time, publish time


@dataclass(frozen=True)
class Channel:
    """A topic in a file."""

    topic: str
    type_name: str
    encoding: str  # of messages; 'cdr' is all we read
    schema_encoding: str  # 'ros2msg' when schema is the text of the definition
    schema: str


class McapFile:
    """
    An MCAP file to be read once from front to back.

    :param path: of the file.
    :raises RecordingError: when it is missing, empty, no regular file, or not MCAP.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}  # by id; grows while messages are read
        self.losses: list[Loss] = []  # complete when all messages are read
        self._schemas: dict[int, Schema] = {}
        # Losses whose end is the first message that comes.
        self._pending: list[tuple[str, str, int]] = []
        self._newest: int | None = None  # log time so far
        self._unpacked = self._records = 0
        self._counts: Counter[int] = Counter()  # channel -> messages read
        try:
            mode = os.stat(path).st_mode  # opening a FIFO would wait for its writer
            if not stat.S_ISREG(mode):
                raise RecordingError(f'{path}: not a regular file; expected an .mcap file')
            with open(path, 'rb') as stream:
                if stream.seek(0, 2) == 0:
                    raise RecordingError(f'{path}: the file is empty')
                self.data = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
        except OSError as error:
            raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
        if self.data[:8] != MAGIC:
            raise RecordingError(
                f'{path}: not an MCAP file: it starts with {self.data[:8].hex(" ")}, '
                f'not {MAGIC.hex(" ")}')
        self._summary, self._complaint = read_summary(self.data)
        for record in self._summary.topics if self._summary else ():
            self._define(record)
        if not all(channel.type_name for channel in self.channels.values()):
            self.channels = {}  # the summary has channels without their types
        self._most_bytes = FREE_BYTES + BYTES_PER_BYTE * len(self.data)
        self._most_records = FREE_RECORDS + len(self.data) // BYTES_PER_RECORD

    def topics(self) -> dict[str, Channel]:
        """
        Return what the file holds.

        Takes it from the summary; a file that has none is read through.

        :return: dict topic -> Channel.
        :raises RecordingError: when nothing can be read.
        """
        if not self.channels:
            for _ in self.messages(()):
                pass
        return {channel.topic: channel for channel in self.channels.values()}

    def counts(self) -> dict[str, int]:
        """Return the number of messages by topic, as the summary says; empty where it does not."""
        known = (self._summary.counts if self._summary else None) or {}
        return {channel.topic: known.get(number, 0) for number, channel in self.channels.items()
                } if known else {}

    def messages(self, wanted: Collection[str]) -> Iterator[tuple[str, int, memoryview]]:
        """
        Yield the messages of some topics in the order of the file.

        What cannot be read is left out, chunk by chunk; `losses` says what it is.

        :param wanted: the topics.
        :return: iterator over (topic, log time in ns, memoryview of its data).
        """
        summary = self._summary
        records = Records(self.data, summary, self._read_topic, self._lose)
        for kind, start, end, entry in records.parts(indexed=bool(self.channels)):
            try:
                data = self.data[start:end]
                if kind == Opcode.CHUNK:
                    chunk = read_chunk(data)
                    self._charge(chunk.uncompressed_size)
                    data = memoryview(unpack(chunk))
                places = self._scan(data)
            except RecordingError as error:
                listed = entry is not None or not (summary and summary.chunks)
                what = 'chunk' if kind == Opcode.CHUNK and listed else 'record'
                self._lose(str(error), what, start - RECORD.size * (kind == Opcode.CHUNK), entry)
                continue
            for place in places:
                _, length, number, _, log, _ = _MESSAGE.unpack_from(data, place)
                channel = self.channels.get(number)
                if channel is not None and channel.topic in wanted:
                    end = place + RECORD.size + length
                    yield channel.topic, min(log, FAR), data[place + _MESSAGE.size:end]
        for loss in self._pending:
            self.losses.append(Loss(*loss, self._newest, self._newest))
        self._pending = []
        self._compare(records, wanted)

    def _scan(self, data: memoryview) -> 'array[int]':
        """Check records, take notice of topics, and return where messages start, array of int."""
        places, position = array('q'), 0
        counts: Counter[int] = Counter()
        logs: dict[int, tuple[int, int]] = {}
        try:
            while position < len(data):
                kind, length = RECORD.unpack_from(data, position)
                end = position + RECORD.size + length
                self._records += 1
                if self._records > self._most_records:
                    raise RecordingError(
                        f'it is left out: the file holds more than {self._most_records} records, '
                        f'in {len(self.data)} bytes')
                if kind == Opcode.MESSAGE:
                    _, _, number, _, log, _ = _MESSAGE.unpack_from(data, position)
                    if position + _MESSAGE.size > end:
                        raise RecordingError('it holds a damaged record: too short')
                    places.append(position)
                    counts[number] += 1
                    first, last = logs.get(number, (log, log))
                    logs[number] = min(first, log), max(last, log)
                elif kind in TOPIC_RECORDS:
                    self._read_topic(kind, data[position + RECORD.size:end])
                elif kind < OTHERS:
                    raise RecordingError(f'it holds a damaged record: opcode {kind}')
                position = end
        except struct.error as error:
            raise RecordingError('it holds a damaged record: cut off') from error
        if position != len(data):
            raise RecordingError('it holds a damaged record: wrong length')
        if places:
            self._place(min(min(first, FAR) for first, _ in logs.values()),
                        max(min(last, FAR) for _, last in logs.values()))
        self._counts += counts
        self.losses += [
            Loss(f'messages of channel {number}, which nothing describes', 'block', None,
                 min(first, FAR), min(last, FAR))
            for number, (first, last) in logs.items() if number not in self.channels]
        return places

    def _read_topic(self, kind: int, content: memoryview) -> None:
        """Take notice of the content of a schema or channel record."""
        self._define(read_record(TOPIC_RECORDS[kind], content, whole=True))

    def _define(self, record: Schema | ChannelRecord) -> None:
        """Take notice of a schema or channel; the first of a number holds."""
        if isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)
        elif record.id not in self.channels:
            schema = self._schemas.get(record.schema_id, Schema(0, b'', '', ''))
            self.channels[record.id] = Channel(
                record.topic, schema.name, record.message_encoding, schema.encoding,
                schema.data.decode(errors='replace'))

    def _charge(self, size: int) -> None:
        """Refuse to unpack more than any recording of this size holds."""
        self._unpacked += size
        if self._unpacked > self._most_bytes:
            raise RecordingError(
                f'it is not unpacked: more than {self._most_bytes} bytes in all, from a file of '
                f'{len(self.data)}')

    def _lose(self, why: str, what: str, byte: int, entry: ChunkEntry | None = None) -> None:
        """Note what cannot be read: at the log times of entry, or between the messages around."""
        if entry is not None:
            self.losses.append(Loss(why, what, byte, entry.start, entry.end))
        else:
            self._pending.append((why, what, byte))

    def _place(self, first: int, last: int) -> None:
        """Note the log times of messages; what was lost before ends with the first of them."""
        for loss in self._pending:
            start = first if self._newest is None else min(self._newest, first)
            self.losses.append(Loss(*loss, start, max(first, start)))
        self._pending = []
        self._newest = last if self._newest is None else max(last, self._newest)

    def _compare(self, records: Records, wanted: Collection[str]) -> None:
        """Compare what was read with the summary."""
        counts = self._summary.counts if self._summary else None
        for entry in in_order(records.missing):
            self._lose('it is not where the summary says', 'chunk', entry.offset, entry)
        missing = {} if counts is None else {
            number: (count - self._counts[number], count)
            for number, count in counts.items() if count > self._counts[number]}
        if counts is not None and not missing:  # what was skipped held no message
            self.losses = [loss for loss in self.losses if loss.what != 'record']
        lines = [
            f'{left} of {count} of topic {escaped(self.channels[number].topic)}'
            for number, (left, count) in missing.items()
            if number in self.channels and self.channels[number].topic in wanted]
        if lines:
            self.losses.append(Loss(f'messages are missing: {", ".join(lines)}', cuts=NOTHING))
        if self._complaint:
            self.losses.append(Loss(self._complaint, cuts=NOTHING))
        if records.cut_off is not None:
            end = self._newest
            self.losses.append(Loss(
                f'the file is cut off at byte {records.cut_off} of {len(self.data)}; '
                'all that was written completely before is used',
                start=None if end is None else end + 1, end=end))
