# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the chunks and messages of an MCAP file lie, damaged or not."""

from collections.abc import Callable, Iterable, Iterator
import struct

from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from tap_ros.errors import RecordingError
from tap_ros.recording.damage import FAR
from tap_ros.recording.summary import ChunkEntry, MAGIC, RECORD, Summary

TOPIC_RECORDS: dict[int, type[Schema] | type[Channel]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}
OTHERS = 0x80  # opcodes from here on belong to others, and are skipped
_RUN_BYTES = 2**20  # of messages outside of chunks that are taken together


class Records:
    """
    The records of a file before its summary.

    :param data: memoryview of the whole file.
    :param summary: Summary or None.
    :param define: function(opcode, content) of schemas and channels outside of chunks.
    :param lose: function(why, what, byte) called for records that are not understood.
    """

    def __init__(self, data: memoryview, summary: Summary | None,
                 define: Callable[[int, memoryview], object],
                 lose: Callable[[str, str, int], object]) -> None:
        self.data, self.summary, self.define, self.lose = data, summary, define, lose
        self.missing: set[ChunkEntry] = set(summary.chunks if summary else ())  # not found so far
        self.cut_off: int | None = None  # the byte where an unfinished file ends
        self.attachments: list[tuple[int, int]] = []  # content found when walked over, start, end

    def parts(self, indexed: bool) -> Iterator[tuple[int, int, int, ChunkEntry | None]]:
        """
        Yield (opcode, start, end, entry) of chunks and of runs of messages outside of them.

        start and end are those of a chunk's content, or of a run's records; entry is what the
        summary says of the chunk, or None.

        :param indexed: whether a summary that lists chunks may be relied on; else, or when it is
            not where it should be, the records are walked over.
        """
        if not (indexed and self.summary and self.summary.placed and self.summary.chunks):
            yield from self._walk()
            return
        for entry in in_order(self.missing):
            last = self.summary.start - entry.length
            if RECORD.size <= entry.length and len(MAGIC) <= entry.offset <= last:
                kind, length = RECORD.unpack_from(self.data, entry.offset)
                if kind == Opcode.CHUNK or length == entry.length - RECORD.size:  # one may be bad
                    self.missing.remove(entry)
                    end = entry.offset + entry.length
                    yield Opcode.CHUNK, entry.offset + RECORD.size, end, entry

    def _walk(self) -> Iterator[tuple[int, int, int, ChunkEntry | None]]:
        position, run = len(MAGIC), None
        entries: dict[tuple[int, int, int], list[ChunkEntry]] = {}
        for entry in in_order(self.missing):
            entries.setdefault((entry.length, entry.start, entry.end), []).append(entry)
        limit = self.summary.start if self.summary else len(self.data)
        while True:
            kind, length = (RECORD.unpack_from(self.data, position)
                            if position + RECORD.size <= limit else (0, 0))
            start, end = position + RECORD.size, position + RECORD.size + length
            broken = kind == 0 or end > limit  # zeros were never written
            if run is not None and (broken or kind != Opcode.MESSAGE or end - run > _RUN_BYTES):
                yield Opcode.MESSAGE, run, position, None
                run = None
            if broken:
                if not self.summary:
                    self.cut_off = position
                elif position < limit:
                    self.lose('it is not understood', 'record', position)
                return
            if kind == Opcode.DATA_END and length == 4:
                return
            if kind == Opcode.MESSAGE:
                run = position if run is None else run
            elif kind == Opcode.CHUNK:
                yield kind, start, end, self._find(start, end, entries)
            elif kind in TOPIC_RECORDS:
                try:
                    self.define(kind, self.data[start:end])
                except RecordingError as error:
                    self.lose(str(error), 'record', position)
            elif not self._is_other(kind, start, end):
                self.lose('it is not understood', 'record', position)
            position = end

    def _is_other(self, kind: int, start: int, end: int) -> bool:
        """Tell whether a record is one of those that hold no messages; note attachments."""
        if kind == Opcode.ATTACHMENT:
            self.attachments.append((start, end))
        if kind == Opcode.MESSAGE_INDEX:  # a damaged chunk may look like one
            return end - start >= 6 and struct.unpack_from(
                '<I', self.data, start + 2)[0] == end - start - 6
        return kind in (Opcode.HEADER, Opcode.ATTACHMENT, Opcode.METADATA) or kind >= OTHERS

    def _find(self, start: int, end: int,
              entries: dict[tuple[int, int, int], list[ChunkEntry]]) -> ChunkEntry | None:
        """Take the entry of a chunk out of those of the summary; return None without one."""
        if end - start < 16:
            return None
        first, last = struct.unpack_from('<QQ', self.data, start)
        same = entries.get((end - start + RECORD.size, min(first, FAR), min(last, FAR)))
        if not same:
            return None
        self.missing.remove(same[0])
        return same.pop(0)


def in_order(entries: Iterable[ChunkEntry]) -> list[ChunkEntry]:
    """Sort entries of the summary as their chunks lie in the file."""
    return sorted(entries, key=lambda entry: entry.offset)
