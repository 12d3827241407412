# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of bags that ROS 2 keeps in sqlite3, with metadata.yaml or without."""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
import sqlite3

from mcap.summary import Summary
from tap_ros.errors import RecordingError
from tap_ros.recording.damage import FAR, Loss
from tap_ros.recording.file_bytes import bytes_of, PACKED
from tap_ros.recording.mcap_file import Channel, Found, McapFile
from tap_ros.text import escaped

MAGIC = b'SQLite format 3\0'


class SqliteFile(McapFile):
    """A file in sqlite3, read as McapFile reads one of MCAP."""

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.losses: list[Loss] = []
        self._counts = Counter[int]()
        self._summary, self._is_read = Summary(), True  # the number of messages is known
        self._newest: int | None = None
        try:
            with closing(self._open()) as base:
                self._describe(base)
        except (sqlite3.Error, ValueError) as error:
            raise RecordingError(
                f'{escaped(path)}: cannot be read: {escaped(error)}; copy it again') from error

    def _describe(self, base: sqlite3.Connection) -> None:
        """Learn of the channels, and how many messages each has."""
        texts = dict[str, str]()
        with suppress(sqlite3.Error):  # bags before Iron have none
            texts = dict(base.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions '
                "WHERE encoding = 'ros2msg'"))
        for number, topic, kind, encoding in base.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            text = texts.get(kind, '')
            self.channels[number] = Channel(
                topic, kind, encoding, 'ros2msg' if text else '', text)
        self._counts.update(dict(base.execute(
            'SELECT topic_id, count(*) FROM messages GROUP BY topic_id')))

    def _blocks(self) -> Iterator[list[Found]]:
        try:
            with closing(self._open()) as base:
                for number, log, data in base.execute(
                        'SELECT topic_id, timestamp, data FROM messages ORDER BY id'):
                    self._newest = min(log, FAR)
                    yield [(number, log, log, memoryview(data))]
        except sqlite3.Error as error:
            behind = None if self._newest is None else self._newest + 1
            self.losses.append(Loss(f'all behind is lost: {escaped(error)}', start=behind,
                                    end=self._newest))

    def _conclude(self, wanted: Collection[str]) -> None:
        """Leave it to what _blocks said."""

    def _open(self) -> sqlite3.Connection:
        """Open the file, with what a killed recorder left beside it; nothing there is changed."""
        path = Path(self.path)
        if path.suffix in PACKED:
            base = sqlite3.connect(':memory:')
            base.deserialize(bytes_of(path))
            return base
        way = 'mode=ro' if path.with_name(f'{path.name}-wal').exists() else 'immutable=1'
        return sqlite3.connect(f'{path.absolute().as_uri()}?{way}', uri=True)
