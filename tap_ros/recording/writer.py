# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write recordings: MCAP files and bags as rosbag2 would write them with `ros2 bag record -s mcap`.

`BagWriter` writes the messages of a running system, `EpisodeWriter` finished episodes. Equal input
gives equal bytes: no clock is read into the file.
"""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack, suppress
import os
from pathlib import Path
from typing import Any, Self

from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.base.errors import RecordingError
from tap_ros.base.files import storage_errors
from tap_ros.messages import topics
from tap_ros.messages.images import (
    camera_info_fields,
    image_fields,
    jpeg_fields,
    mask_fields,
)
from tap_ros.messages.joints import joint_fields
from tap_ros.messages.objects import objects_fields
from tap_ros.messages.stamps import header_fields, stamp_fields
from tap_ros.recording import metadata
from tap_ros.recording.episode import check_episode, Episode
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.messages import encode, schema_text, type_hash, typestore

EPISODE_GAP_NS = 10**9  # between episodes whose stamps do not follow each other
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


class EpisodeWriter:
    """
    Write finished episodes into one MCAP file, with marks where they start and end.

    Use it as a context manager: the file gets its name when the block ends without an error, and
    is called path.part until then. The log time of a message is its stamp; where the stamps of an
    episode do not follow those before it, its log times are moved behind them.

    :param path: of the file; replaced when it exists.
    :param compression: 'zstd', 'lz4' or 'none'.
    :param camera_matrix: (3, 3) intrinsics for /camera/camera_info; None: uncalibrated (zeros).
    :param jpeg: keep frames as JPEG, on /camera/image_raw/compressed.
    """

    def __init__(self, path: str | Path, compression: str = 'zstd',
                 camera_matrix: ArrayLike | None = None, jpeg: bool = False) -> None:
        self._jpeg = jpeg
        self.path, self._stack = Path(path), ExitStack()
        self._file = self._stack.enter_context(new_file(self.path, compression))
        self._camera_matrix = np.zeros((3, 3)) if camera_matrix is None else np.asarray(
            camera_matrix, float)
        self._last_log: int | None = None
        self._goals: set[topics.Topic] = set()  # topics of the goal that hold

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def write(self, episode: Episode) -> None:
        """
        Append an episode.

        :param episode: Episode.
        :raises RecordingError: when a field has the wrong type, shape or order.
        """
        check_episode(episode)
        first, last = int(episode.stamps[0]), int(episode.stamps[-1])
        self._shift = 0
        if self._last_log is not None and first <= self._last_log:
            self._shift = self._last_log + EPISODE_GAP_NS - first
        self._mark(episode, first, event=0)
        self._goal(episode, first)
        for t, stamp in enumerate(episode.stamps.tolist()):
            self._step(episode, t, stamp)
        self._mark(episode, last, event=1)
        self._last_log = last + self._shift

    def _step(self, episode: Episode, t: int, stamp: int) -> None:
        """Write all messages of one time step."""
        frame = episode.frames[t]
        self._put(topics.CLOCK, stamp, {'clock': stamp_fields(stamp)})
        self._put(topics.CAMERA_INFO, stamp, camera_info_fields(
            self._camera_matrix, frame.shape[:2], stamp, CAMERA_FRAME))
        if self._jpeg:
            self._file.write_raw(
                f'{topics.IMAGE.recorded}/compressed', topics.COMPRESSED_TYPE, encode(
                    topics.COMPRESSED_TYPE, jpeg_fields(frame, stamp, CAMERA_FRAME)),
                stamp + self._shift)
        else:
            self._put(topics.IMAGE, stamp, image_fields(frame, stamp, CAMERA_FRAME))
        if episode.robot_masks is not None:
            self._put(topics.ROBOT_MASK, stamp, mask_fields(
                episode.robot_masks[t], stamp, CAMERA_FRAME))
        if episode.object_names:
            self._put(topics.OBJECTS, stamp, objects_fields(
                episode.object_names, episode.object_pixels[t], episode.object_poses[t], stamp,
                WORLD_FRAME, episode.object_source))
        if not np.isnan(episode.grippers[t]).all():
            self._put(topics.JOINT_STATES, stamp, joint_fields(
                episode.grippers[t], stamp, WORLD_FRAME))
        if episode.signals is not None:
            self._put(topics.SIGNALS, stamp, {
                'header': header_fields(stamp, ''), 'name': list(episode.signal_names),
                'position': episode.signals[t].astype(float)})
        if t < len(episode.stamps) - 1 and not np.isnan(episode.actions[t]).all():
            x, y, z, opening = episode.actions[t].tolist()
            self._put(topics.TWIST, stamp, {
                'header': header_fields(stamp, WORLD_FRAME),
                'twist': {'linear': {'x': x, 'y': y, 'z': z}}})
            self._put(topics.GRIPPER_COMMAND, stamp, {'data': opening})

    def _goal(self, episode: Episode, stamp: int) -> None:
        """Write the goal; an empty one takes back that of the episode before."""
        at = stamp, CAMERA_FRAME
        for topic, goal, fields in (
                (topics.GOAL_IMAGE, episode.goal_frame, image_fields(episode.goal_frame, *at)),
                (topics.GOAL_ROBOT_MASK, episode.goal_mask, mask_fields(episode.goal_mask, *at)),
                (topics.GOAL_OBJECTS, episode.object_names or None, objects_fields(
                    episode.object_names, episode.goal_pixels, episode.goal_poses, stamp,
                    WORLD_FRAME, episode.object_source))):
            if goal is not None or topic in self._goals:
                self._put(topic, stamp, fields)
            (self._goals.discard if goal is None else self._goals.add)(topic)

    def _mark(self, episode: Episode, stamp: int, event: int) -> None:
        self._put(topics.EPISODE, stamp, {
            'header': header_fields(stamp, ''), 'event': event, 'task': episode.task,
            'seed': int(episode.seed), 'outcome': episode.outcome if event else ''})

    def _put(self, topic: topics.Topic, stamp: int, message: dict[str, Any]) -> None:
        self._file.write_raw(
            topic.recorded, topic.type, encode(topic.type, message), stamp + self._shift)


def write_metadata(folder: str | Path) -> None:
    """
    Write metadata.yaml of a bag of finished files of EpisodeWriter.

    :param folder: of the bag; the files play in the order of the numbers in their names.
    :raises RecordingError: when there is no .mcap file, or one is not finished.
    """
    files = metadata.files_by_number(folder)
    if not files:
        raise RecordingError(f'{folder}: holds no .mcap file')
    metadata.save(folder, [_describe(path) for path in files])


def count_episodes(path: Path) -> int:
    """
    Count the episodes in a finished file, by the marks of their starts and ends.

    :raises RecordingError: when the file is not finished.
    """
    marks = _describe(path)['topics'].get(topics.EPISODE.recorded)
    return marks['count'] // 2 if marks else 0


def _describe(path: Path) -> dict[str, Any]:
    """Describe a finished file as FileWriter.close does."""
    file = McapFile(path)
    if not (statistics := file.summary.statistics):
        raise RecordingError(f'{path}: not a finished MCAP file: it has no summary')
    return {
        'path': path.name, 'start': statistics.message_start_time,
        'end': statistics.message_end_time, 'message_count': statistics.message_count,
        'topics': {topic: {'type': kind, 'qos': [topics.default_qos(topic).profile()],
                           'type_hash': type_hash(kind), 'count': count}
                   for (topic, kind), count in file.counts().items()}}
