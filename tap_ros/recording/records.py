# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file in their order, past damage where the summary knows the way."""

from bisect import bisect_right
import struct

from tap_ros.errors import RecordingError
from tap_ros.recording.losses import FAR
from tap_ros.recording.summary import CHANNEL, CHUNK, DATA_END, MAGIC, MESSAGE, RECORD, SCHEMA

_HEADER, _MESSAGE_INDEX, _ATTACHMENT, _METADATA, _OTHERS = 1, 7, 9, 12, 0x80
_EMPTY_INDEX = 6  # bytes: channel, size of the entries
_RUN_BYTES = 2**20  # of messages outside of chunks that are taken together


class Records:
    """
    Iterate over (opcode, start, end, index, entry) of chunks and of runs of messages.

    start and end are those of a chunk's content, or of a run's records; index are (start, length)
    of the message indices behind a chunk; entry is its ChunkEntry, or None.

    A chunk that the summary lists is found though its opcode or length are damaged.

    :param data: the whole file.
    :param summary: Summary or None.
    :param define: function(opcode, content) of schemas and channels.
    :param lose: function(why, what, byte, entry) called for records that are not understood.
    """

    def __init__(self, data, summary, define, lose):
        self.data, self.summary, self.define, self.lose = memoryview(data), summary, define, lose
        self.limit = summary.start if summary else len(data)
        self.cut_off = None  # the byte where an unfinished file ends
        self._missing = {}  # (length, start, end) -> entries that were not found yet
        for entry in summary.chunks if summary else ():
            self._missing.setdefault((entry.length, entry.start, entry.end), []).append(entry)
        self._known = {}
        for entry in summary.chunks if summary and summary.placed else ():
            last = self.limit - entry.length
            if RECORD.size <= entry.length and len(MAGIC) <= entry.offset <= last:
                kind, length = RECORD.unpack_from(self.data, entry.offset)
                if kind == CHUNK or length == entry.length - RECORD.size:
                    self._known[entry.offset] = entry
        self._offsets = sorted(self._known)
        self._lost_to = None  # where what was last lost ended

    @property
    def missing(self):
        """Return the entries of the summary that were not found."""
        return sorted((e for entries in self._missing.values() for e in entries),
                      key=lambda entry: entry.offset)

    def __iter__(self):
        position, run, chunk = len(MAGIC), None, None
        while True:
            entry = self._known.get(position)
            kind, end = (CHUNK, position + entry.length) if entry else self._next(position)
            if chunk and kind != _MESSAGE_INDEX:
                yield chunk
                chunk = None
            if run is not None and (kind != MESSAGE or end - run > _RUN_BYTES):
                yield MESSAGE, run, position, [], None
                run = None
            start = position + RECORD.size
            if kind == DATA_END or (kind is None and self.summary and position >= self.limit):
                return
            if kind is None:
                if not self.summary:
                    self.cut_off = position
                    return
                self._skip(position, end)
            elif kind == MESSAGE:
                run = position if run is None else run
            elif kind in (SCHEMA, CHANNEL):
                try:
                    self.define(kind, self.data[start:end])
                except RecordingError:
                    self._skip(position, end)
            elif kind == CHUNK:
                chunk = (CHUNK, start, end, [], self._find(start, end, entry))
            elif kind == _MESSAGE_INDEX and chunk:
                if end - start > _EMPTY_INDEX:
                    chunk[3].append((start, end - start))
            elif kind not in (_ATTACHMENT, _METADATA) and kind < _OTHERS and (
                    kind != _HEADER or position != len(MAGIC)):
                self._skip(position, end)
            position = end

    def _next(self, position):
        """
        Return (opcode, end) of the record at a place.

        The opcode is None where there is none, end then the next place known to hold one. Message
        indices, messages and ends of data that cannot be are given the opcode 0.
        """
        later = bisect_right(self._offsets, position)
        bound = self._offsets[later] if later < len(self._offsets) else self.limit
        if position + RECORD.size > bound:
            return None, bound
        kind, length = RECORD.unpack_from(self.data, position)
        end = position + RECORD.size + length
        if end > bound or kind == 0:  # zeros: what was never written
            return None, bound
        if kind == _MESSAGE_INDEX and not self._is_index(position + RECORD.size, length):
            return 0, end
        if kind == MESSAGE and self._known:  # all lie in chunks
            return 0, end
        if kind == DATA_END and (length != 4 or (self.summary and end < self.limit)):
            return 0, end
        return kind, end

    def _is_index(self, start, length):
        """Tell whether the lengths in a message index agree."""
        return length % 16 == _EMPTY_INDEX and (
            struct.unpack_from('<I', self.data, start + 2)[0] == length - _EMPTY_INDEX)

    def _find(self, start, end, entry):
        """Return the entry of a chunk in the summary, None without one; note that it was found."""
        if entry is not None:
            key = entry.length, entry.start, entry.end
        elif end - start >= 16:
            first, last = struct.unpack_from('<QQ', self.data, start)
            key = end - start + RECORD.size, min(first, FAR), min(last, FAR)
        else:
            return None
        entries = self._missing.get(key)
        if not entries:
            return None
        found = entry or entries[0]
        entries.remove(found)
        return found

    def _skip(self, start, end):
        """Note a record that is not understood; those that follow each other count as one."""
        if start != self._lost_to:
            self.lose('it is not understood', 'record', start)
        self._lost_to = end
