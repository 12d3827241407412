# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The summary of an MCAP file: what its writer says the file holds."""

from dataclasses import dataclass
import struct
import zlib

from tap_ros.recording.losses import FAR

MAGIC = b'\x89MCAP0\r\n'
RECORD = struct.Struct('<BQ')  # opcode, length of what follows
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 3, 4, 5, 6, 15
_FOOTER, _CHUNK_INDEX, _STATISTICS = 2, 8, 11
_FOOTER_RECORD = struct.Struct('<BQQQI')  # header, summary start, summary offsets start, crc
DAMAGED = 'its summary is damaged, so that nothing tells whether all messages are there'


@dataclass(frozen=True)
class ChunkEntry:
    """A chunk as the summary lists it."""

    offset: int  # of its record
    length: int  # of its record, with the header
    start: int  # ns, log time of its first message
    end: int  # ns, of its last


@dataclass(frozen=True)
class Summary:
    """What stands behind the data of a file."""

    start: int  # where it begins in the file
    placed: bool  # whether that is where it should, so that offsets hold
    topics: list  # of (opcode, content) of its schema and channel records
    chunks: list  # of ChunkEntry, empty when it lists none
    counts: dict | None  # channel -> number of messages; None when it does not say


def read_summary(data):
    """
    Read the summary of a file.

    :param data: bytes-like, the whole file.
    :return: (Summary, ''), or (None, why it cannot be used; '' when there never was one, or when
        the file is cut off).
    """
    data = memoryview(data)
    footer = len(data) - _FOOTER_RECORD.size - len(MAGIC)
    if footer < len(MAGIC):
        return None, ''
    kind, length, start, _, crc = _FOOTER_RECORD.unpack_from(data, footer)
    sound = (
        data[-len(MAGIC):] == MAGIC and kind == _FOOTER
        and length == _FOOTER_RECORD.size - RECORD.size)
    if sound and start == 0:
        return None, ''
    placed = sound and _holds(data, start, footer, crc)
    if not placed:  # bytes were lost or put in before it, or the end is damaged or missing
        start = _data_end(data)
        if start is None:
            return None, DAMAGED if sound else ''
        if not sound or not _holds(data, start, footer, crc):
            return None, DAMAGED
    try:
        return _parse(data, start, footer, placed), ''
    except struct.error:
        return None, DAMAGED


def _holds(data, start, footer, crc):
    """Tell whether a summary lies between two places."""
    if not len(MAGIC) < start <= footer:
        return False
    if crc:
        return zlib.crc32(data[start:footer + _FOOTER_RECORD.size - 4]) == crc
    position = start
    while position < footer:
        position += RECORD.size + RECORD.unpack_from(data, position)[1]
    return position == footer


def _data_end(data):
    """Return where the data of a file end by its records, None when they do not."""
    position = len(MAGIC)
    while position + RECORD.size <= len(data):
        kind, length = RECORD.unpack_from(data, position)
        position += RECORD.size + length
        if kind == DATA_END and length == 4:
            return position
    return None


def _parse(data, start, footer, placed):
    topics, chunks, counts, position = [], [], None, start
    while position + RECORD.size <= footer:
        kind, length = RECORD.unpack_from(data, position)
        body = data[position + RECORD.size:min(position + RECORD.size + length, footer)]
        position += RECORD.size + length
        if kind in (SCHEMA, CHANNEL):
            topics.append((kind, body))
        elif kind == _CHUNK_INDEX:
            first, last, offset, size = struct.unpack_from('<QQQQ', body)
            chunks.append(ChunkEntry(offset, size, min(first, FAR), min(last, FAR)))
        elif kind == _STATISTICS:
            (size,) = struct.unpack_from('<I', body, 42)
            counts = dict(struct.iter_unpack('<HQ', body[46:46 + size]))
    return Summary(start, placed, topics, chunks, counts)
