# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write finished episodes as a recording; equal ones give equal bytes."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import CAMERA_FRAME, CONTROL_PERIOD, WORLD_FRAME
from tap_ros.base.errors import RecordingError
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
from tap_ros.recording.file_writer import new_file
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.messages import encode, type_hash

EPISODE_GAP_NS = 10**9  # between episodes whose stamps do not follow each other
Views = Mapping[str, Iterable[np.ndarray | None]]  # pictures of each frame's time, by camera


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
        self._told = False  # of what unit the commands are
        self._goals: set[topics.Topic] = set()  # topics of the goal that hold

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def write(self, episode: Episode, views: Views | None = None) -> None:
        """
        Append an episode.

        :param episode: Episode.
        :param views: what other cameras saw, each on the topic that topics.camera_view gives its
            name: for each frame a picture, uint8 (H, W, 3) rgb of any size, or None.
        :raises RecordingError: when a field has the wrong type, shape or order.
        :raises ConfigError: for a name that no topic can have.
        """
        check_episode(episode)
        others = [(topics.camera_view(name), f'{name}_optical_frame', iter(pictures))
                  for name, pictures in (views or {}).items()]
        first, last = int(episode.stamps[0]), int(episode.stamps[-1])
        self._shift = 0
        if self._last_log is not None and first <= self._last_log:
            self._shift = self._last_log + EPISODE_GAP_NS - first
        self._mark(episode, first, event=0)
        self._goal(episode, first)
        for t, stamp in enumerate(episode.stamps.tolist()):
            self._step(episode, t, stamp)
            for topic, frame_id, pictures in others:
                if (picture := next(pictures, None)) is not None:
                    self._picture(topic, stamp, picture, frame_id)
        self._mark(episode, last, event=1)
        self._last_log = last + self._shift

    def _step(self, episode: Episode, t: int, stamp: int) -> None:
        """Write all messages of one time step."""
        frame = episode.frames[t]
        self._put(topics.CLOCK, stamp, {'clock': stamp_fields(stamp)})
        self._put(topics.CAMERA_INFO, stamp, camera_info_fields(
            self._camera_matrix, frame.shape[:2], stamp, CAMERA_FRAME))
        self._picture(topics.IMAGE, stamp, frame, CAMERA_FRAME)
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
            if not self._told:
                self._told = True
                self._put(topics.CONTROL_PERIOD, stamp, {'data': CONTROL_PERIOD})
            self._put(topics.TWIST, stamp, {
                'header': header_fields(stamp, WORLD_FRAME),
                'twist': {'linear': {
                    axis: way / CONTROL_PERIOD for axis, way in zip('xyz', (x, y, z))}}})
            self._put(topics.GRIPPER_COMMAND, stamp, {'data': opening})

    def _picture(self, topic: topics.Topic, stamp: int, picture: np.ndarray,
                 frame_id: str) -> None:
        """Write a picture as it is, or as JPEG."""
        if self._jpeg:
            self._file.write_raw(
                f'{topic.recorded}/compressed', topics.COMPRESSED_TYPE, encode(
                    topics.COMPRESSED_TYPE, jpeg_fields(picture, stamp, frame_id)),
                stamp + self._shift)
        else:
            self._put(topic, stamp, image_fields(picture, stamp, frame_id))

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
