# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of bags that ROS 2 keeps in sqlite3; which of both kinds a file is."""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
import os
from pathlib import Path
import re
import sqlite3

from mcap.summary import Summary
from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.recording.defects import Defect, FAR
from tap_ros.recording.mcap_file import Channel, Found, MAX_CHUNK_BYTES, McapFile
from tap_ros.recording.metadata import PACKED
from tap_ros.recording.raw_files import beginning, bytes_of

_STEP = 10**4  # instructions of sqlite for 100 bytes of a file; a row takes some tens
SQLITE = b'SQLite format 3\0'


class SqliteFile(McapFile):
    """A file of a bag that ROS 2 keeps in sqlite3, read as McapFile reads one of MCAP."""

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.defects: list[Defect] = []
        self._counts = Counter[int]()
        self.summary, self._is_read = Summary(), True  # the number of messages is known
        self._size = os.stat(path).st_size
        try:
            with closing(self._open()) as base:
                self._describe(base)
        except (sqlite3.Error, ValueError) as error:
            raise RecordingError(
                f'{escaped(path)}: cannot be read: {escaped(error)}; copy it again') from error

    def _describe(self, base: sqlite3.Connection) -> None:
        """Learn of the channels, and how many messages each has."""
        for name, text in base.execute(  # a view or a formula may have no end
                "SELECT name, sql FROM sqlite_master WHERE type IN ('table', 'view') "
                "AND lower(name) IN ('topics', 'messages', 'message_definitions')"):
            text = str(text)
            if not re.match(r'CREATE TABLE\b', text) or re.search(r'(?i)\bAS\b', text):
                raise ValueError(f'{name} is no plain table')
        texts = dict[str, str]()
        with suppress(sqlite3.Error):  # bags before Iron have none
            texts = dict(base.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions '
                "WHERE encoding = 'ros2msg'"))
        for number, topic, kind, encoding in base.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            text = texts.get(kind, '')
            if not all(isinstance(word, str) for word in (topic, kind, encoding, text)):
                raise ValueError('topics holds what is no text')
            self.channels[number] = Channel(
                topic, kind, encoding, 'ros2msg' if text else '', text)
        self._counts.update(dict(base.execute(
            'SELECT topic_id, count(*) FROM messages GROUP BY topic_id')))

    def _blocks(self) -> Iterator[list[Found]]:
        try:
            with closing(self._open()) as base:
                for number, log, data in base.execute(
                        'SELECT topic_id, timestamp, data FROM messages ORDER BY id'):
                    if not isinstance(log, int) or not isinstance(data, bytes):
                        self.defects.append(Defect('it holds no message', 'row', cuts=False))
                        continue
                    self._newest = min(log, FAR)
                    yield [(number, log, log, memoryview(data))]
        except sqlite3.Error as error:
            behind = None if self._newest is None else self._newest + 1
            self.defects.append(Defect(f'all behind is lost: {escaped(error)}', start=behind,
                                    end=self._newest))

    def _blocks_at(self, log: int) -> Iterator[list[Found]]:
        with suppress(sqlite3.Error), closing(self._open()) as base:
            for number, data in base.execute(
                    'SELECT topic_id, data FROM messages WHERE timestamp = ?', (log,)):
                if isinstance(data, bytes):
                    yield [(number, log, log, memoryview(data))]

    def _conclude(self, wanted: Collection[str]) -> None:
        """Leave it to what _blocks said."""

    def _open(self) -> sqlite3.Connection:
        """Open the file, with what a killed recorder left beside it; nothing there is changed."""
        path = Path(self.path)
        if path.suffix in PACKED:
            base, data = sqlite3.connect(':memory:'), bytes_of(path)
            base.deserialize(data)
            size = len(data)
        else:
            size, log = self._size, path.with_name(f'{path.name}-wal')
            size += log.stat().st_size if log.is_file() else 0
            way = 'mode=ro' if log.is_file() else 'immutable=1'
            base = sqlite3.connect(f'{path.absolute().as_uri()}?{way}', uri=True)
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
        steps = iter(range(1000 + size // 100))  # pages may stand in each other: rows without end
        base.set_progress_handler(lambda: next(steps, None) is None, _STEP)
        return base


def open_file(path: Path) -> McapFile:
    """
    Open one file of a bag.

    :raises RecordingError: as McapFile.
    """
    return (SqliteFile if beginning(path).startswith(SQLITE) else McapFile)(path)
