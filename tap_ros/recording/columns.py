# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The messages of one file as arrays: one column a field, rows in the order of the log.

Nothing is cut or aligned here, so that a file can be decoded, and kept, by itself even when an
episode goes on in the next one.
"""

from contextlib import contextmanager
from dataclasses import dataclass, field
import json

import numpy as np
from tap_ros.errors import RecordingError
from tap_ros.recording import topics
from tap_ros.recording.codec import Layout
from tap_ros.recording.container import gather
from tap_ros.recording.pictures import check_size, Picture

_ENDINGS = ('_log', '_stamp', '_names', '_event', '_index')  # of column names
_KEPT_BYTES = 2**26  # of messages that wait to be decoded together
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
    :param write_frames: called with a list of buffers, each the H * W * 3 bytes of one camera
        image, in the order of the file; they are not to be kept.
    :return: Columns without frames; its 'frame_order' (F,) int64 puts what was written in order.
    :raises RecordingError: when a message cannot be used; it names the file and the topic.
    """
    decoder = _Decoder(file, found, write_frames)
    for block in file.blocks(set(found.values())):
        decoder.take(block)
    return decoder.finish()


class _Decoder:
    """
    Collects the columns of a file block by block.

    Camera images are passed on at once. The bytes of all other messages are kept and decoded
    together, many at a time.
    """

    def __init__(self, file, found, write_frames):
        self.file = file
        self.found = found
        self.write_frames = write_frames
        self.columns = Columns(str(file.path))
        self.parts = {}  # column -> list of arrays
        self.layouts = {}  # (type, size) -> list of Layout
        self.names = {}  # tuple of object names -> number
        self.goals = []
        self.taken = 0  # messages
        self.kept, self.kept_bytes = {}, 0  # name -> size -> list of (number, log, bytes)
        self.decode = {
            topics.TWIST: self._twists, topics.GRIPPER_COMMAND: self._commands,
            topics.JOINT_STATES: self._joints, topics.EPISODE: self._marks,
            topics.OBJECTS: lambda *a: self._objects('object', *a),
            topics.GOAL_OBJECTS: lambda *a: self._objects('goal_object', *a)}

    def take(self, block):
        """Take all messages of a block."""
        for name, topic in self.found.items():
            rows = block.messages.get(topic)
            if rows is None:
                continue
            with self._naming(topic):
                if name == topics.IMAGE:
                    self._images(block, rows)
                elif name == topics.GOAL_IMAGE:
                    self._goal_images(block, rows)
                else:
                    self._keep(name, block, rows)
            self.taken += len(rows)
        if self.kept_bytes > _KEPT_BYTES:
            self._decode_kept()

    def finish(self):
        """Put the parts together, rows in the order of their log times."""
        self._decode_kept()
        for key in ('object', 'goal_object'):
            self.parts[key] = pad_objects(self.parts.get(key, []))
        arrays = {key: np.concatenate(part) for key, part in self.parts.items() if part}
        columns = self.columns
        for number in [key for key in arrays if key.endswith('_number')]:
            name = number.removesuffix('_number')
            order = np.lexsort((arrays.pop(number), arrays[f'{name}_log']))
            for key in (name, *(name + end for end in _ENDINGS)):
                if key in arrays:
                    arrays[key] = arrays[key][order]
            if name == 'mark':
                columns.marks = [columns.marks[i] for i in order.tolist()]
            elif name == 'frame':
                arrays['frame_order'] = order.astype(np.int64)
        columns.arrays = arrays
        columns.names = list(self.names)
        if self.goals:
            columns.goal_frames = np.stack(self.goals)
            if columns.image_size is not None:
                with self._naming(self.found[topics.GOAL_IMAGE]):
                    check_size(
                        self.goals[0].shape, columns.image_size, 'camera and goal images')
        columns.damage = self.file.damage
        return columns

    @contextmanager
    def _naming(self, topic):
        """Name the file and the topic in errors."""
        try:
            yield
        except RecordingError as error:
            raise RecordingError(f'{self.file.path}: topic {topic}: {error}') from error

    def _keep(self, name, block, rows):
        """Copy the bytes of messages out of a block, to be decoded later."""
        numbers = self.taken + np.arange(len(rows))
        sizes = rows[:, 2]
        same = (sizes == sizes[0]).all()
        for size in sizes[:1].tolist() if same else np.unique(sizes).tolist():
            own = slice(None) if same else sizes == size
            data = gather(block.buffer, rows[own, 1], size)
            self.kept.setdefault(name, {}).setdefault(size, []).append(
                (numbers[own], rows[own, 0], data))
            self.kept_bytes += data.size

    def _decode_kept(self):
        for name, by_size in self.kept.items():
            with self._naming(self.found[name]):
                for parts in by_size.values():
                    numbers, logs, data = (np.concatenate(p) for p in zip(*parts, strict=True))
                    for own, layout in self._groups(
                            topics.TYPES[name], data.shape[1], len(data),
                            lambda rows, width, data=data: data[rows, :width]):
                        self.decode[name](numbers[own], logs[own], layout, data[own])
        self.kept, self.kept_bytes = {}, 0

    def _groups(self, kind, size, count, heads, **options):
        """
        Sort messages of one size by their structure.

        :param heads: function(rows, width) -> (n, width) uint8, the first bytes of some messages.
        :return: iterator over (rows, Layout).
        """
        known = self.layouts.setdefault((kind, size), [])
        left, tried = np.arange(count), 0
        while len(left):
            if tried == len(known):
                known.append(Layout(kind, heads(left[:1], size)[0], **options))
            layout = known[tried]
            tried += 1
            same = layout.matches(heads(left, layout.prefix))
            if same.any():
                yield left[same], layout
                left = left[~same]

    def _add(self, name, numbers, logs, **values):
        """Append values that belong to messages."""
        values |= {f'{name}_number': numbers, f'{name}_log': logs}
        for key, value in values.items():
            self.parts.setdefault(key, []).append(value)

    def _pictures(self, block, rows):
        """Yield (rows, size, stamps, buffers) of images of one structure; H * W * 3 bytes each."""
        for size in np.unique(rows[:, 2]).tolist():
            own = np.flatnonzero(rows[:, 2] == size)
            starts = rows[own, 1]

            def heads(part, width, starts=starts):
                return gather(block.buffer, starts[part], width)

            for group, layout in self._groups(
                    topics.TYPES[topics.IMAGE], size, len(own), heads,
                    skip='data', same=('height', 'width', 'step')):
                picture = Picture.of(layout)
                stamps = layout.stamps(heads(group, layout.prefix))
                yield own[group], picture, stamps, [
                    picture.rgb(block.buffer, start + layout.prefix)
                    for start in starts[group].tolist()]

    def _images(self, block, rows):
        stamps, buffers = np.empty(len(rows), np.int64), [None] * len(rows)
        for group, picture, stamps[group], found in self._pictures(block, rows):
            if self.columns.image_size is None:
                self.columns.image_size = picture.size
            check_size(picture.size, self.columns.image_size, 'images')
            for i, buffer in zip(group.tolist(), found, strict=True):
                buffers[i] = buffer
        self.write_frames(buffers)
        self._add('frame', self.taken + np.arange(len(rows)), rows[:, 0], frame_stamp=stamps)

    def _goal_images(self, block, rows):
        for group, picture, stamps, found in self._pictures(block, rows):
            index = np.full(len(group), -1)
            if 0 not in picture.size:
                index[:] = np.arange(len(group)) + len(self.goals)
                self.goals += [np.array(b).reshape(*picture.size, 3) for b in found]
                check_size(self.goals[-1].shape, self.goals[0].shape, 'goal images')
            self._add('goal', self.taken + group, rows[group, 0], goal_stamp=stamps,
                      goal_index=index)

    def _twists(self, numbers, logs, layout, data):
        linear = layout.column(data, *(f'twist.linear.{axis}' for axis in 'xyz'))
        self._add('twist', numbers, logs, twist=linear.astype(np.float32),
                  twist_stamp=layout.stamps(data))

    def _commands(self, numbers, logs, layout, data):
        self._add('command', numbers, logs, command=layout.column(data, 'data').astype(np.float32))

    def _joints(self, numbers, logs, layout, data):
        names = [layout.strings[f'name[{i}]'] for i in range(layout.counts['name'])]
        positions = layout.column(data, 'position')
        joints = np.full((len(data), 4), np.nan, np.float32)
        for column, name in enumerate(topics.GRIPPER_JOINTS):
            if name in names and names.index(name) < positions.shape[1]:
                joints[:, column] = positions[:, names.index(name)]
        if not np.isnan(joints).all():
            self._add('joint', numbers, logs, joint=joints, joint_stamp=layout.stamps(data))

    def _objects(self, column, numbers, logs, layout, data):
        K = layout.counts['objects']
        names = tuple(layout.strings[f'objects[{i}].name'] for i in range(K))
        number = self.names.setdefault(names, len(self.names))
        values = np.empty((len(data), K, 9))
        for i in range(K):
            values[:, i] = layout.column(
                data, *(f'objects[{i}].{path}' for path in ('u', 'v', *_POSE)))
        self._add(column, numbers, logs, **{
            f'{column}_stamp': layout.stamps(data), column: values,
            f'{column}_names': np.full(len(data), number)})

    def _marks(self, numbers, logs, layout, data):
        self._add('mark', numbers, logs, mark_stamp=layout.stamps(data),
                  mark_event=layout.column(data, 'event').astype(np.int64))
        for seed in layout.column(data, 'seed').tolist():
            self.columns.marks.append((layout.strings['task'], seed, layout.strings['outcome']))


def pad_objects(parts):
    """Give all arrays (N, K, 9) the largest K, with NaN for objects that are not there."""
    K = max((part.shape[1] for part in parts), default=0)
    return [
        np.pad(part, ((0, 0), (0, K - part.shape[1]), (0, 0)), constant_values=np.nan)
        if part.shape[1] < K else part for part in parts]
