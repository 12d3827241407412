# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The summary of an MCAP file: what its writer says the file holds."""

from dataclasses import dataclass
from io import BytesIO
import struct
import zlib

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC
from tap_ros.recording.chunks import DAMAGE
from tap_ros.recording.damage import FAR

RECORD = struct.Struct('<BQ')  # opcode, length of what follows
_FOOTER = struct.Struct('<BQQQI')  # opcode, length, summary start, summary offsets start, crc
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
    topics: list[Schema | Channel]  # of mcap.records
    chunks: list[ChunkEntry]  # empty when it lists none
    counts: dict[int, int] | None  # channel -> number of messages; None when it does not say
    attachments: list[AttachmentIndex] | None  # of mcap.records; None when it does not list all


def read_summary(data: bytes | memoryview) -> tuple[Summary | None, str]:
    """
    Read the summary of a file.

    :param data: bytes-like, the whole file.
    :return: (Summary, ''), or (None, why it cannot be used; '' when there never was one, or when
        the file is cut off).
    """
    data = memoryview(data)
    footer = len(data) - _FOOTER.size - len(MAGIC)
    if footer < len(MAGIC):
        return None, ''
    kind, length, start, _, crc = _FOOTER.unpack_from(data, footer)
    sound = (
        data[-len(MAGIC):] == MAGIC and kind == Opcode.FOOTER
        and length == _FOOTER.size - RECORD.size)
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
        return _parse(data[start:], start, placed), ''
    except DAMAGE:
        return None, DAMAGED


def _holds(data: memoryview, start: int, footer: int, crc: int) -> bool:
    """Tell whether a summary lies between two places."""
    if not len(MAGIC) < start <= footer:
        return False
    if crc:
        return zlib.crc32(data[start:footer + _FOOTER.size - 4]) == crc
    position = start
    while position < footer:
        position += RECORD.size + RECORD.unpack_from(data, position)[1]
    return position == footer


def _data_end(data: memoryview) -> int | None:
    """Return where the data of a file end by its records, None when they do not."""
    position = len(MAGIC)
    while position + RECORD.size <= len(data):
        kind, length = RECORD.unpack_from(data, position)
        position += RECORD.size + length
        if kind == Opcode.DATA_END and length == 4:
            return position
    return None


def _parse(data: memoryview, start: int, placed: bool) -> Summary:
    topics, chunks, attachments, counts, attached = [], [], [], None, None
    for record in StreamReader(BytesIO(data), skip_magic=True, emit_chunks=True).records:
        if isinstance(record, (Schema, Channel)):
            topics.append(record)
        elif isinstance(record, ChunkIndex):
            chunks.append(ChunkEntry(
                record.chunk_start_offset, record.chunk_length,
                min(record.message_start_time, FAR), min(record.message_end_time, FAR)))
        elif isinstance(record, AttachmentIndex):
            attachments.append(record)
        elif isinstance(record, Statistics):
            counts, attached = record.channel_message_counts, record.attachment_count
    return Summary(start, placed, topics, chunks, counts,
                   attachments if attached == len(attachments) else None)
