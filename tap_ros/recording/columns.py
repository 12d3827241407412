# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The messages of one file as arrays: one column a field, rows in the order of the log.

Nothing is cut or aligned here, so that a file can be decoded, and kept, by itself even when an
episode goes on in the next one.
"""

from dataclasses import dataclass, field
import json

import numpy as np

from tap_ros.errors import RecordingError
from tap_ros.recording import topics
from tap_ros.recording.codec import Layout

GRIPPER_JOINTS = ('gripper_x', 'gripper_y', 'gripper_z', 'gripper_opening')
_CHANNELS = {'rgb8': 3, 'bgr8': 3, 'rgba8': 4, 'bgra8': 4, 'mono8': 1}
_POSE = [f'pose.position.{a}' for a in 'xyz'] + [f'pose.orientation.{a}' for a in 'xyzw']


@dataclass
class Columns:
    """
    What one file holds; times in nanoseconds, N differs from topic to topic.

    arrays: <name>_log (N,) int64 and, where messages have a header, <name>_stamp (N,) int64, and
        goal_index (N,) int64, row of goal_frames, -1 for an empty picture
        twist (N, 3) float32 linear; command (N,) float32 gripper opening
        joint (N, 4) float32 gripper state, NaN where unknown
        object, goal_object (N, K, 9) float64 u, v, pose; object_names, goal_object_names (N,)
            int64, row of names
        mark_event (N,) int64
    """

    source: str  # what messages call the file
    image_size: tuple | None = None  # (H, W); None without any image
    frames: np.ndarray | None = None  # (F, H, W, 3) uint8, rows belong to frame_log
    goal_frames: np.ndarray | None = None  # (G, H, W, 3) uint8
    arrays: dict = field(default_factory=dict)
    names: list = field(default_factory=list)  # tuples of object names
    marks: list = field(default_factory=list)  # (task, seed, outcome) by row of mark_log
    damage: str = ''  # why the file could not be read to its end

    def describe(self):
        """Return all that is not an array as JSON text."""
        return json.dumps({
            'image_size': self.image_size, 'names': self.names, 'marks': self.marks,
            'damage': self.damage})


def decode_file(file, found, write_frames):
    """
    Read a file once from front to back.

    :param file: McapFile.
    :param found: dict from the names in topics to the file's topics, as topics.resolve gives it.
    :param write_frames: called with (n, H, W, 3) uint8 for every run of camera images, in the
        order of the file.
    :return: Columns without frames; its 'frame_order' (F,) int64 puts what was written in order.
    :raises RecordingError: when a message cannot be used; it names the file and the topic.
    """
    decoder = _Decoder(file, found, write_frames)
    for block in file.blocks():
        decoder.take(block)
    return decoder.finish()


class _Decoder:
    """Collects the columns of a file block by block."""

    def __init__(self, file, found, write_frames):
        self.file = file
        self.write_frames = write_frames
        self.columns = Columns(str(file.path))
        self.parts = {}  # column -> list of arrays
        self.layouts = {}  # (type, size) -> list of Layout
        self.names = {}  # tuple of object names -> number
        self.goals = []
        self.wanted = {topic: name for name, topic in found.items()}
        self.take_topic = {
            topics.IMAGE: self._images, topics.GOAL_IMAGE: self._goal_images,
            topics.TWIST: self._twists, topics.GRIPPER_COMMAND: self._commands,
            topics.JOINT_STATES: self._joints, topics.EPISODE: self._marks,
            topics.OBJECTS: lambda b, s: self._objects('object', b, s),
            topics.GOAL_OBJECTS: lambda b, s: self._objects('goal_object', b, s)}

    def take(self, block):
        """Decode all messages of a block, topic by topic."""
        for number in np.unique(block.channels).tolist():
            channel = self.file.channels.get(number)
            name = self.wanted.get(channel.topic) if channel else None
            if name is None:
                continue
            if channel.encoding != 'cdr':
                raise RecordingError(
                    f'{self.file.path}: topic {channel.topic} is encoded as '
                    f'{channel.encoding!r}; only cdr can be read')
            rows = np.flatnonzero(block.channels == number)
            try:
                self.take_topic[name](block, rows)
            except RecordingError as error:
                raise RecordingError(
                    f'{self.file.path}: topic {channel.topic}: {error}') from error

    def finish(self):
        """Put the parts together, rows in the order of their log times."""
        for key in ('object', 'goal_object'):
            self.parts[key] = pad_objects(self.parts.get(key, []))
        arrays = {key: np.concatenate(part) for key, part in self.parts.items() if part}
        columns = self.columns
        for log in [key for key in arrays if key.endswith('_log')]:
            order = np.argsort(arrays[log], kind='stable')
            name = log.removesuffix('_log')
            if name == 'mark':
                columns.marks = [columns.marks[i] for i in order.tolist()]
            if name == 'frame':
                arrays['frame_order'] = order.astype(np.int64)
            for key in (name, log, f'{name}_stamp', f'{name}_names', f'{name}_event',
                        f'{name}_index'):
                if key in arrays:
                    arrays[key] = arrays[key][order]
        columns.arrays = arrays
        columns.names = list(self.names)
        if self.goals:
            columns.goal_frames = np.stack(self.goals)
        columns.damage = self.file.damage
        return columns

    def _add(self, block, rows, **values):
        """Append values that belong to messages of a block."""
        name = next(iter(values)).split('_stamp')[0]
        values[f'{name}_log'] = block.log_times[rows]
        for key, value in values.items():
            self.parts.setdefault(key, []).append(value)

    def _groups(self, block, rows, name, skip=None):
        """Yield (rows of the block, Layout, their bytes) of messages with the same structure."""
        kind = topics.TYPES[name]
        for size in np.unique(block.sizes[rows]).tolist():
            left = rows[block.sizes[rows] == size]
            known = self.layouts.setdefault((kind, size), [])
            for layout in known:
                if not len(left):
                    break
                data = _gather(block.buffer, block.starts[left], layout.prefix)
                same = layout.matches(data)
                if same.all():
                    yield left, layout, data
                elif same.any():
                    yield left[same], layout, data[same]
                left = left[~same]
            while len(left):
                start = int(block.starts[left[0]])
                layout = Layout(kind, block.buffer[start:start + size], skip)
                known.insert(0, layout)
                data = _gather(block.buffer, block.starts[left], layout.prefix)
                same = layout.matches(data)
                yield left[same], layout, data[same]
                left = left[~same]

    def _images(self, block, rows):
        parts = []
        for group, layout, data in self._groups(block, rows, topics.IMAGE, 'data'):
            frames = _pixels(block, group, layout, data)
            if self.columns.image_size is None:
                self.columns.image_size = frames.shape[1:3]
            _check_size(frames.shape[1:3], self.columns.image_size, 'images')
            parts.append((group, frames, layout.stamps(data)))
        order = np.argsort(np.concatenate([p[0] for p in parts])) if len(parts) > 1 else None
        frames, stamps = (
            parts[0][1:] if order is None
            else (np.concatenate([p[i] for p in parts])[order] for i in (1, 2)))
        self.write_frames(frames)
        self._add(block, rows, frame_stamp=stamps)

    def _goal_images(self, block, rows):
        for group, layout, data in self._groups(block, rows, topics.GOAL_IMAGE, 'data'):
            index = np.full(len(group), -1)
            if layout.counts['data']:
                index[:] = np.arange(len(group)) + len(self.goals)
                self.goals += list(_pixels(block, group, layout, data))
                _check_size(self.goals[-1].shape, self.goals[0].shape, 'goal images')
            self._add(block, group, goal_stamp=layout.stamps(data), goal_index=index)

    def _twists(self, block, rows):
        for group, layout, data in self._groups(block, rows, topics.TWIST):
            linear = layout.column(data, *(f'twist.linear.{axis}' for axis in 'xyz'))
            self._add(
                block, group, twist_stamp=layout.stamps(data), twist=linear.astype(np.float32))

    def _commands(self, block, rows):
        for group, layout, data in self._groups(block, rows, topics.GRIPPER_COMMAND):
            self._add(block, group, command=layout.column(data, 'data').astype(np.float32))

    def _joints(self, block, rows):
        for group, layout, data in self._groups(block, rows, topics.JOINT_STATES):
            names = [layout.strings[f'name[{i}]'] for i in range(layout.counts['name'])]
            positions = layout.column(data, 'position')
            joints = np.full((len(group), 4), np.nan, np.float32)
            for column, name in enumerate(GRIPPER_JOINTS):
                if name in names and names.index(name) < positions.shape[1]:
                    joints[:, column] = positions[:, names.index(name)]
            if not np.isnan(joints).all():
                self._add(block, group, joint_stamp=layout.stamps(data), joint=joints)

    def _objects(self, column, block, rows):
        name = topics.OBJECTS if column == 'object' else topics.GOAL_OBJECTS
        for group, layout, data in self._groups(block, rows, name):
            K = layout.counts['objects']
            names = tuple(layout.strings[f'objects[{i}].name'] for i in range(K))
            number = self.names.setdefault(names, len(self.names))
            values = np.empty((len(group), K, 9))
            for i in range(K):
                values[:, i] = layout.column(
                    data, *(f'objects[{i}].{path}' for path in ('u', 'v', *_POSE)))
            self._add(block, group, **{
                f'{column}_stamp': layout.stamps(data), column: values,
                f'{column}_names': np.full(len(group), number)})

    def _marks(self, block, rows):
        for group, layout, data in self._groups(block, rows, topics.EPISODE):
            self._add(
                block, group, mark_stamp=layout.stamps(data),
                mark_event=layout.column(data, 'event').astype(np.int64))
            for seed in layout.column(data, 'seed').tolist():
                self.columns.marks.append(
                    (layout.strings['task'], seed, layout.strings['outcome']))


def pad_objects(parts):
    """Give all arrays (N, K, 9) the largest K, with NaN for objects that are not there."""
    K = max((part.shape[1] for part in parts), default=0)
    return [
        np.pad(part, ((0, 0), (0, K - part.shape[1]), (0, 0)), constant_values=np.nan)
        if part.shape[1] < K else part for part in parts]


def _gather(buffer, starts, width):
    """Copy out (N, width) bytes, one row from each start."""
    if len(starts) and starts.max() + width > len(buffer):
        raise RecordingError('a message ends behind its chunk')
    if width == 0:
        return np.empty((len(starts), 0), np.uint8)
    windows = np.lib.stride_tricks.as_strided(
        buffer, (len(buffer) - width + 1, width), (1, 1), writeable=False)
    return windows[starts]


def _check_size(size, expected, what):
    if tuple(size) != tuple(expected):
        raise RecordingError(
            f'{what} of different sizes: {expected[1]}x{expected[0]} and {size[1]}x{size[0]} '
            'pixels (width x height); one recording has one size')


def _pixels(block, rows, layout, data):
    """
    Return the pictures of messages with one layout.

    :return: (N, H, W, 3) uint8, rgb.
    :raises RecordingError: for an encoding, step or length that cannot be used.
    """
    encoding = layout.strings['encoding']
    channels = _CHANNELS.get(encoding)
    if channels is None:
        raise RecordingError(
            f'encoding {encoding!r} cannot be read; choose one of {", ".join(_CHANNELS)}')
    shape = layout.column(data, 'height', 'width', 'step')
    if (shape != shape[0]).any():
        raise RecordingError('images of different sizes; one recording has one size')
    height, width, step = shape[0].tolist()
    length = layout.counts['data']
    if 0 in (height, width) or step < width * channels or length != height * step:
        raise RecordingError(
            f'a {encoding} image of {width}x{height} pixels with step {step} and {length} bytes '
            f'of data; expected a step of at least {width * channels} and step * height bytes')
    raw = _gather(block.buffer, block.starts[rows] + layout.prefix, length)
    pixels = raw.reshape(len(rows), height, step)[:, :, :width * channels]
    pixels = pixels.reshape(len(rows), height, width, channels)
    if encoding == 'mono8':
        return np.repeat(pixels, 3, 3)
    return pixels[..., :3] if encoding.startswith('rgb') else pixels[..., 2::-1]
