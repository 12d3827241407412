# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write recordings: MCAP files and bags as rosbag2 would write them with `ros2 bag record -s mcap`.

`BagWriter` writes the messages of a running system, `EpisodeWriter` finished episodes.
"""

from contextlib import suppress
import os
from pathlib import Path
import struct
from typing import Any, Self

from mcap.exceptions import McapError
from mcap.reader import make_reader
import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.base.errors import RecordingError
from tap_ros.base.files import storage_errors
from tap_ros.base.text import escaped
from tap_ros.messages import topics
from tap_ros.messages.images import camera_info_fields, image_fields, mask_fields
from tap_ros.messages.joints import joint_fields
from tap_ros.messages.objects import objects_fields
from tap_ros.messages.stamps import header_fields, stamp_fields
from tap_ros.recording import metadata
from tap_ros.recording.episode import check_episode, Episode
from tap_ros.recording.file_writer import FileWriter
from tap_ros.recording.messages import encode, type_hash, typestore

EPISODE_GAP_NS = 10**9  # between episodes whose stamps do not follow each other


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


class EpisodeWriter:
    """
    Write finished episodes into one MCAP file, with marks where they start and end.

    Use it as a context manager: the file gets its name when the block ends without an error, and
    is called path.part until then. The log time of a message is its stamp; where the stamps of an
    episode do not follow those before it, its log times are moved behind them.

    :param path: of the file; replaced when it exists.
    :param compression: 'zstd', 'lz4' or 'none'.
    :param camera_matrix: (3, 3) intrinsics for /camera/camera_info; None: uncalibrated (zeros).
    """

    def __init__(self, path: str | Path, compression: str = 'zstd',
                 camera_matrix: ArrayLike | None = None) -> None:
        self.path = Path(path)
        self._part = self.path.with_name(self.path.name + '.part')
        with storage_errors(self.path):
            self._part.unlink(missing_ok=True)
        self._file = FileWriter(self._part, self.path.name, compression)
        self._camera_matrix = np.zeros((3, 3)) if camera_matrix is None else np.asarray(
            camera_matrix, float)
        self._last_log: int | None = None
        self._goals: set[topics.Topic] = set()  # topics of the goal that hold

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._file.close()
                with storage_errors(self.path):
                    os.replace(self._part, self.path)
        finally:
            self._file.abandon()
            with suppress(OSError):  # on a disk that is gone
                self._part.unlink(missing_ok=True)

    def write(self, episode: Episode) -> None:
        """
        Append an episode.

        :param episode: Episode.
        :raises RecordingError: when a field has the wrong type, shape or order.
        """
        check_episode(episode)
        shift = 0
        if self._last_log is not None and episode.stamps[0] <= self._last_log:
            shift = self._last_log + EPISODE_GAP_NS - int(episode.stamps[0])
        self._shift = shift
        first, last = int(episode.stamps[0]), int(episode.stamps[-1])
        self._mark(episode, first, event=0)
        self._goal(episode, first)
        for t, stamp in enumerate(episode.stamps.tolist()):
            self._step(episode, t, stamp)
        self._mark(episode, last, event=1)
        self._last_log = last + shift

    def _step(self, episode: Episode, t: int, stamp: int) -> None:
        """Write all messages of one time step."""
        frame = episode.frames[t]
        self._put(topics.CLOCK, stamp, {'clock': stamp_fields(stamp)})
        self._put(topics.CAMERA_INFO, stamp, camera_info_fields(
            self._camera_matrix, frame.shape[:2], stamp, CAMERA_FRAME))
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
        if t < len(episode.stamps) - 1 and not np.isnan(episode.actions[t]).all():
            x, y, z, opening = episode.actions[t].tolist()
            self._put(topics.TWIST, stamp, {
                'header': header_fields(stamp, WORLD_FRAME),
                'twist': {'linear': {'x': x, 'y': y, 'z': z}}})
            self._put(topics.GRIPPER_COMMAND, stamp, {'data': opening})

    def _goal(self, episode: Episode, stamp: int) -> None:
        """Write the goal; an empty one takes back that of the episode before."""
        for topic, fields, picture in (
                (topics.GOAL_IMAGE, image_fields, episode.goal_frame),
                (topics.GOAL_ROBOT_MASK, mask_fields, episode.goal_mask)):
            if picture is not None or topic in self._goals:
                self._put(topic, stamp, fields(picture, stamp, CAMERA_FRAME))
            (self._goals.discard if picture is None else self._goals.add)(topic)
        if episode.object_names or topics.GOAL_OBJECTS in self._goals:
            self._put(topics.GOAL_OBJECTS, stamp, objects_fields(
                episode.object_names, episode.goal_pixels, episode.goal_poses, stamp,
                WORLD_FRAME, episode.object_source))
            self._goals.add(topics.GOAL_OBJECTS)
            if not episode.object_names:
                self._goals.discard(topics.GOAL_OBJECTS)

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
    marks = _describe(path)['topics'].get(topics.EPISODE.recorded, {'count': 0})
    return marks['count'] // 2


def _describe(path: Path) -> dict[str, Any]:
    """Describe a finished file as FileWriter.close does."""
    try:
        with open(path, 'rb') as stream:
            summary = make_reader(stream).get_summary()
    except (OSError, McapError, ValueError, LookupError, ArithmeticError, MemoryError,
            struct.error) as error:
        raise RecordingError(
            f'{path}: not a finished MCAP file: {escaped(error)}') from error
    if summary is None or summary.statistics is None:
        raise RecordingError(f'{path}: not a finished MCAP file: it has no summary')
    counts = summary.statistics.channel_message_counts
    found = {}
    for channel in summary.channels.values():
        kind = summary.schemas[channel.schema_id].name
        found[channel.topic] = {
            'type': kind, 'qos': [topics.default_qos(channel.topic).profile()],
            'type_hash': type_hash(kind), 'count': counts.get(channel.id, 0)}
    return {
        'path': path.name, 'start': summary.statistics.message_start_time,
        'end': summary.statistics.message_end_time,
        'message_count': summary.statistics.message_count, 'topics': found}
