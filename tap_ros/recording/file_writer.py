# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write messages into MCAP files, and bags as rosbag2 does with `ros2 bag record -s mcap`.

Equal input gives equal bytes: no clock is read into the file.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
from pathlib import Path
from typing import Any, Self

from mcap.writer import CompressionType, IndexType, Writer
from tap_ros.base.errors import RecordingError
from tap_ros.base.files import storage_errors
from tap_ros.messages import topics
from tap_ros.recording import metadata
from tap_ros.recording.messages import schema_text, type_hash, typestore

LIBRARY = 'tap_ros 1'
CHUNK_BYTES = 786432  # rosbag2's default
_COMPRESSIONS = {one.name.lower(): one for one in CompressionType}


class FileWriter:
    """
    Write serialized messages into one MCAP file.

    Complete chunks are readable even when the process is killed. `close` finishes the file.

    :param path: of the file; must not exist.
    :param name: of the file in its bag; by default the file's own.
    :param compression: 'zstd', 'lz4' or 'none', of the chunks.
    :raises RecordingError: for an unknown compression, and a file that exists.
    """

    def __init__(self, path: str | Path, name: str = '', compression: str = 'zstd') -> None:
        if compression not in _COMPRESSIONS:
            raise RecordingError(
                f'compression: expected zstd, lz4 or none, got {compression!r}')
        self.path = Path(path)
        try:
            self._stream = open(self.path, 'xb')
        except OSError as error:
            raise RecordingError(f'{self.path}: cannot be created: {error.strerror}') from error
        self._writer = Writer(
            self._stream, chunk_size=CHUNK_BYTES, compression=_COMPRESSIONS[compression],
            index_types=IndexType.ALL)
        self._writer.start(profile='ros2', library=LIBRARY)
        self._schemas: dict[str, int] = {}  # type -> id
        self._channels: dict[str, int] = {}  # topic -> id
        self._info: dict[str, Any] = {
            'path': name or self.path.name, 'start': 0, 'end': 0, 'message_count': 0,
            'topics': {}}

    def write_raw(self, topic: str, type_name: str, data: bytes, log_time_ns: int,
                  publish_time_ns: int | None = None, qos: topics.Qos | None = None) -> None:
        """
        Append one message.

        :param topic: full name, for example '/camera/image_raw'.
        :param type_name: for example 'sensor_msgs/msg/Image'.
        :param data: the serialized message (CDR), bytes.
        :param log_time_ns: when it was received.
        :param publish_time_ns: when it was published; by default the same.
        :param qos: topics.Qos offered by the publisher; used at the topic's first message.
        :raises RecordingError: for a type without definition, or another one than before.
        :raises StorageError: when it cannot be written.
        """
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._open_topic(topic, type_name, qos or topics.default_qos(topic))
        info = self._info['topics'][topic]
        if info['type'] != type_name:
            raise RecordingError(
                f'{self.path}: topic {topic} has the type {info["type"]}, not {type_name}')
        publish = log_time_ns if publish_time_ns is None else publish_time_ns
        with storage_errors(self.path):
            self._writer.add_message(channel, int(log_time_ns), data, int(publish), info['count'])
        info['count'] += 1
        total = self._info
        if not total['message_count'] or log_time_ns < total['start']:
            total['start'] = log_time_ns
        total['end'] = max(total['end'], log_time_ns)
        total['message_count'] += 1

    def flush(self) -> None:
        """Finish the chunk in progress, so that what was written so far can be read."""
        with storage_errors(self.path):
            self._writer.flush()

    def close(self) -> dict[str, Any]:
        """
        Finish the file.

        :return: dict that describes it, as metadata.bag_information takes it.
        :raises StorageError: when it cannot be written; what was flushed before is readable.
        """
        if not self._stream.closed:
            text = metadata.to_yaml(metadata.bag_information([self._info]))
            try:
                with storage_errors(self.path):
                    self._writer.add_metadata('rosbag2', {'serialized_metadata': text})
                    self._writer.finish()
                    self._stream.flush()
                    os.fsync(self._stream.fileno())
            finally:
                self.abandon()
        return self._info

    def abandon(self) -> None:
        """Close without finishing the file; what was flushed is readable."""
        with suppress(OSError):  # what a full disk refuses again
            self._stream.close()

    def _open_topic(self, topic: str, type_name: str, qos: topics.Qos) -> int:
        """Register a topic, and its type when it is new."""
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', schema_text(type_name).encode())
        profiles = [qos.profile()]
        self._channels[topic] = self._writer.register_channel(
            topic, 'cdr', self._schemas[type_name],
            {'offered_qos_profiles': metadata.to_yaml(profiles).strip(),
             'topic_type_hash': type_hash(type_name)})
        self._info['topics'][topic] = {
            'type': type_name, 'qos': profiles, 'type_hash': type_hash(type_name), 'count': 0}
        return self._channels[topic]


class BagWriter(FileWriter):
    """
    Write the messages of a running system into a new bag.

    :param folder: of the bag; must not exist, or be empty.
    :param compression: 'zstd', 'lz4' or 'none'.
    :raises RecordingError: when the folder holds something, or cannot be made.
    """

    def __init__(self, folder: str | Path, compression: str = 'zstd') -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            occupied = any(self.folder.iterdir())
        except OSError as error:
            raise RecordingError(f'{folder}: cannot be made: {error.strerror}') from error
        if occupied:
            raise RecordingError(f'{folder}: is not empty; name a new folder for the recording')
        typestore()  # takes a moment, which no message should wait for
        super().__init__(
            self.folder / f'{self.folder.resolve().name}_0.mcap', compression=compression)

    def close(self) -> dict[str, Any]:
        """
        Finish the bag: its file and metadata.yaml.

        :raises StorageError: when it cannot be; what was flushed before is readable.
        """
        information = super().close()
        metadata.save(self.folder, [information])
        return information

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def new_file(path: str | Path, compression: str = 'zstd') -> Iterator[FileWriter]:
    """
    Write an MCAP file that is called path.part until the block ends without an error.

    :param path: of the file; replaced when it exists.
    """
    path = Path(path)
    part = path.with_name(f'{path.name}.part')
    with storage_errors(path):
        part.unlink(missing_ok=True)
    file = FileWriter(part, path.name, compression)
    try:
        yield file
        file.close()
        with storage_errors(path):
            os.replace(part, path)
    finally:
        file.abandon()
        with suppress(OSError):  # on a disk that is gone
            part.unlink(missing_ok=True)
