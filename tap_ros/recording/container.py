# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
MCAP files, read front to back, block by block, as fast as they unpack.

A block is an unpacked chunk with a table of its messages; their bytes stay where they are. Nothing
but complete records is used, so what a killed recorder left is read too. What cannot be used, or
is not where the summary says, is noted as a loss.
"""

from collections import Counter
from dataclasses import dataclass
import mmap
import os
import stat
import struct

import numpy as np
from tap_ros.errors import RecordingError
from tap_ros.recording.chunks import claimed_size, MAX_CHUNK_BYTES, unpack
from tap_ros.recording.losses import FAR, Loss, NOTHING
from tap_ros.recording.records import Records
from tap_ros.recording.summary import (
    CHANNEL,
    CHUNK,
    DAMAGED,
    MAGIC,
    MESSAGE,
    read_summary,
    RECORD,
    SCHEMA,
)
from tap_ros.text import escaped

# Bounds on what a file may unpack to, far above what recordings of its size hold.
FREE_BYTES, BYTES_PER_BYTE = 2**28, 1024
FREE_MESSAGES, BYTES_PER_MESSAGE = 2**18, 4
_MESSAGE_HEAD = np.dtype([
    ('kind', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'), ('log', '<u8'),
    ('publish', '<u8')])
_HEAD_BYTES = _MESSAGE_HEAD.itemsize
_INDEX_START = 6  # bytes before the entries of a message index: channel, size of the entries


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
    :raises RecordingError: when it is missing, empty, no regular file, or not MCAP.
    """

    def __init__(self, path):
        self.path = path
        self.channels = {}  # id -> Channel; grows while blocks are read
        self.losses = []  # of Loss, complete when all blocks are read
        self._schemas = {}
        self._pending = []  # losses whose end is the first message that comes
        self._newest = None  # log time so far
        self._unpacked = self._messages = 0
        self._counts = Counter()  # channel -> messages read
        try:
            mode = os.stat(path).st_mode  # opening a FIFO would wait for its writer
            if not stat.S_ISREG(mode):
                raise RecordingError(f'{path}: not a regular file; expected an .mcap file')
            with open(path, 'rb') as stream:
                if stream.seek(0, 2) == 0:
                    raise RecordingError(f'{path}: the file is empty')
                self.data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
        if self.data[:8] != MAGIC:
            raise RecordingError(
                f'{path}: not an MCAP file: it starts with {self.data[:8].hex(" ")}, '
                f'not {MAGIC.hex(" ")}')
        self._summary, self._complaint = read_summary(self.data)
        try:
            for kind, record in self._summary.topics if self._summary else ():
                self._define(kind, record)
        except RecordingError:
            self._summary, self._complaint = None, DAMAGED
            self.channels, self._schemas = {}, {}
        if not all(channel.type_name for channel in self.channels.values()):
            self.channels = {}  # the summary has channels without their types
        size = len(self.data)
        self._most_bytes = FREE_BYTES + BYTES_PER_BYTE * size
        self._most_messages = FREE_MESSAGES + size // BYTES_PER_MESSAGE

    def topics(self):
        """
        Return what the file holds.

        Takes it from the summary; a file that has none is read through.

        :return: dict topic -> Channel.
        :raises RecordingError: when nothing can be read.
        """
        if not self.channels:
            for _ in self.blocks(()):
                pass
        return {channel.topic: channel for channel in self.channels.values()}

    def blocks(self, wanted):
        """
        Yield the messages of some topics, block by block, in the order of the file.

        A block is good until the next one is asked for: buffers are used again, because fresh
        memory costs as much as unpacking into it.

        What cannot be read is left out; `losses` says what it is.

        :param wanted: the topics.
        """
        buffer = np.empty(0, np.uint8)
        records = Records(self.data, self._summary, self._define, self._lose)
        for kind, start, end, index, entry in records:
            try:
                if kind == CHUNK:
                    view = memoryview(self.data)[start:end]
                    self._charge(claimed_size(view))
                    data, buffer = unpack(view, buffer)
                else:
                    data = np.frombuffer(self.data, np.uint8, end - start, start)
                block = self._block(data, index, wanted)
            except RecordingError as error:
                listed = entry is not None or not (self._summary and self._summary.chunks)
                what = 'chunk' if kind == CHUNK and listed else 'record'
                self._lose(str(error), what, start - RECORD.size * (kind == CHUNK), entry)
                continue
            yield block
        for loss in self._pending:
            self.losses.append(Loss(*loss, self._newest, self._newest))
        self._pending = []
        self._compare(records, wanted)

    def _charge(self, size):
        """Refuse to unpack more than any recording of this size holds."""
        self._unpacked += size if size <= MAX_CHUNK_BYTES else 0  # else it is refused anyway
        if self._unpacked > self._most_bytes:
            raise RecordingError(
                f'it is not unpacked: more than {self._most_bytes} bytes in all, from a file of '
                f'{len(self.data)}')

    def _lose(self, why, what, byte, entry=None):
        """Note what cannot be read: at the log times of entry, or between the messages around."""
        if entry is not None:
            self.losses.append(Loss(why, what, byte, entry.start, entry.end))
        else:
            self._pending.append((why, what, byte))

    def _place(self, first, last):
        """Note the log times of a block; what was lost before it ends with its first message."""
        for loss in self._pending:
            start = first if self._newest is None else min(self._newest, first)
            self.losses.append(Loss(*loss, start, max(first, start)))
        self._pending = []
        self._newest = last if self._newest is None else max(last, self._newest)

    def _compare(self, records, wanted):
        """Compare what was read with the summary."""
        counts = self._summary.counts if self._summary else None
        missing = records.missing
        self.losses = [loss for loss in self.losses if loss.what != 'record' or not any(
            entry.offset <= loss.byte < entry.offset + entry.length for entry in missing)]
        for entry in missing:
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

    def _block(self, buffer, index, wanted):
        """Make the tables of the messages in a buffer, and note the topics defined in it."""
        positions = self._positions(buffer, index)
        heads = _heads(buffer, positions)
        sizes = heads['length'].astype(np.int64) - _HEAD_BYTES + RECORD.size
        if sizes.min(initial=0) < 0:
            raise RecordingError('it holds a damaged record: too short')
        self._messages += len(positions)
        if self._messages > self._most_messages:
            raise RecordingError(
                f'it is left out: more than {self._most_messages} messages in all, in a file of '
                f'{len(self.data)} bytes')
        logs = np.minimum(heads['log'], FAR).astype(np.int64)
        if len(logs):
            self._place(int(logs.min()), int(logs.max()))
        table = np.stack([logs, positions + _HEAD_BYTES, sizes], 1)
        found = {}
        for number, count in Counter(heads['channel'].tolist()).items():
            self._counts[number] += count
            channel = self.channels.get(number)
            if channel is None:
                own = logs[heads['channel'] == number]
                self.losses.append(Loss(
                    f'messages of channel {number}, which nothing describes', 'block', None,
                    int(own.min()), int(own.max())))
            elif channel.topic in wanted:
                found.setdefault(channel.topic, []).append(
                    np.flatnonzero(heads['channel'] == number))
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
            raise RecordingError('its index points out of it')
        heads = _heads(buffer, positions)
        lengths = np.minimum(heads['length'], size).astype(np.int64)
        ends = np.concatenate([[0], positions + RECORD.size + lengths])
        starts = np.append(positions, size)
        if (starts < ends).any() or (heads['kind'] != MESSAGE).any():
            raise RecordingError('its index does not point to messages')
        gaps = np.flatnonzero(starts != ends)
        more = [self._walk(buffer, int(ends[i]), int(starts[i])) for i in gaps]
        return np.sort(np.concatenate([positions, *more])) if more else positions

    def _walk(self, buffer, position, end):
        """Go over records one by one; note topics and return where messages start, (N,) int64."""
        found, data, left = [], memoryview(buffer), self._most_messages
        try:
            while position < end and left:
                kind, length = RECORD.unpack_from(data, position)
                left -= 1
                if kind == MESSAGE:
                    found.append(position)
                elif kind in (SCHEMA, CHANNEL):
                    self._define(kind, data[position + 9:position + 9 + length])
                elif kind < 0x80:  # those above are of others, and are skipped
                    raise RecordingError(f'it holds a damaged record: opcode {kind}')
                position += RECORD.size + length
        except struct.error as error:
            raise RecordingError(f'it holds a damaged record: {error}') from error
        if position < end:
            raise RecordingError(f'it holds more than {self._most_messages} records')
        if position != end or (found and found[-1] + _HEAD_BYTES > end):
            raise RecordingError('it holds a damaged record: wrong length')
        return np.array(found, np.int64)

    def _define(self, kind, record):
        """Read a schema or channel record; the first of a number holds."""
        try:
            if kind == SCHEMA:
                (number,) = struct.unpack_from('<H', record)
                name, position = _text(record, 2)
                encoding, position = _text(record, position)
                schema, end = _text(record, position, 'replace')
                about = name, encoding, schema
            else:
                number, schema = struct.unpack_from('<HH', record)
                topic, position = _text(record, 4)
                encoding, position = _text(record, position)
                (size,) = struct.unpack_from('<I', record, position)
                end = position + 4 + size
        except (struct.error, UnicodeDecodeError) as error:
            raise RecordingError(f'damaged topic record: {error}') from error
        if end != len(record):
            raise RecordingError('damaged topic record: wrong length')
        if kind == SCHEMA:
            self._schemas.setdefault(number, about)
        else:
            name, *about = self._schemas.get(schema, ('', '', ''))
            self.channels.setdefault(number, Channel(topic, name, encoding, *about))


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


def _text(record, position, errors='strict'):
    (length,) = struct.unpack_from('<I', record, position)
    position += 4
    if position + length > len(record):
        raise struct.error('a text ends behind it')
    return bytes(record[position:position + length]).decode(errors=errors), position + length
