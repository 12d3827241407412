# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The messages of one file as arrays: one column a field, rows in the order of the log.

Nothing is cut or aligned here, so that a file can be decoded, and kept, by itself even when an
episode goes on in the next one. A message that cannot be used is left out and noted.
"""

from collections import Counter
from dataclasses import dataclass, field
import json

import numpy as np
from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.errors import RecordingError
from tap_ros.recording import topics
from tap_ros.recording.codec import Layout
from tap_ros.recording.container import gather, McapFile
from tap_ros.recording.losses import describe, EVERYTHING, FRAMES, gaps, Loss, NOTHING
from tap_ros.recording.pictures import Picture
from tap_ros.text import escaped

_ENDINGS = ('_log', '_stamp', '_names', '_event', '_index')  # of column names
_KEPT_BYTES = 2**26  # of messages that wait to be decoded together
_GROUP_ROWS = 4096  # messages whose structures are compared together
_RECENT = 8  # structures that are tried first
# Fields read one by one to find out where they lie: so many in any file, and one in so many bytes.
_FREE_FIELDS, _BYTES_PER_FIELD = 2**18, 64
_FIELD_BYTES, _MESSAGE_FIELDS = 8, 16  # bytes of a field at least; fields of an image at most
_PADDED_BYTES, _PADDING = 2**28, 16  # objects may be padded to so much, or so many times theirs
_CUTS = {topics.IMAGE: FRAMES, topics.TWIST: FRAMES, topics.GRIPPER_COMMAND: FRAMES,
         topics.EPISODE: EVERYTHING}  # what may be missing where one is; else NOTHING
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
        gap (G, 3) int64: where episodes are cut, as losses.gaps gives it
    """

    source: str  # what messages call the file
    image_size: tuple | None = None  # (H, W); None without any image
    frames: np.ndarray | None = None  # (F, H, W, 3) uint8, rows belong to frame_log
    goal_frames: np.ndarray | None = None  # (G, H, W, 3) uint8
    arrays: dict = field(default_factory=dict)
    names: list = field(default_factory=list)  # tuples of object names
    marks: list = field(default_factory=list)  # (task, seed, outcome) by row of mark_log
    damage: list = field(default_factory=list)  # lines: what could not be used, and why

    def describe(self):
        """Return all that is not an array as JSON text."""
        return json.dumps({
            'image_size': self.image_size, 'names': self.names, 'marks': self.marks,
            'damage': self.damage})


def decode_file(path, found, write_frames, restart):
    """
    Read a file from front to back.

    Pictures of another size than the most of a file are left out, as are those that cannot be
    used.

    :param path: of the file.
    :param found: dict from the names in topics to the file's topics, as topics.resolve gives it.
    :param write_frames: called with a list of buffers, each the H * W * 3 bytes of one camera
        image, in the order of the file; they are not to be kept.
    :param restart: called without arguments when all that was written is to be forgotten, because
        the first picture was not of the size that most are.
    :return: Columns without frames; its 'frame_order' (F,) int64 puts what was written in order.
    :raises RecordingError: when no size of pictures is that of more than half of them, or the
        file would take more memory than any recording of its size; it names the file.
    """
    size = None
    while True:
        decoder = _Decoder(McapFile(path), found, write_frames, size)
        try:
            for block in decoder.file.blocks(set(found.values())):
                decoder.take(block)
            most = decoder.most_frequent_size()
            if most == decoder.columns.image_size:
                return decoder.finish()
        except RecordingError as error:
            raise RecordingError(f'{path}: {error}') from error
        size = most
        restart()


class _Decoder:
    """
    Collects the columns of a file block by block.

    Camera images are passed on at once. The bytes of all other messages are kept and decoded
    together, many at a time.
    """

    def __init__(self, file, found, write_frames, size):
        self.file = file
        self.found = found
        self.write_frames = write_frames
        self.columns = Columns(str(file.path), size)
        self.sizes = Counter()  # (H, W) -> camera images
        self.losses = []
        self.parts = {}  # column -> list of arrays
        self.layouts = {}  # (type, size) -> list of Layout, those used last first
        self.fields = 0  # read to make layouts
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
            if name == topics.IMAGE:
                self._images(block, rows)
            elif name == topics.GOAL_IMAGE:
                self._goal_images(block, rows)
            else:
                self._keep(name, block, rows)
            self.taken += len(rows)
        if self.kept_bytes > _KEPT_BYTES:
            self._decode_kept()

    def most_frequent_size(self):
        """Return the size of more than half of the camera images, None without any."""
        if not self.sizes:
            return None
        (size, count), *_ = self.sizes.most_common(1)
        if 2 * count <= self.sizes.total():
            listing = ', '.join(f'{n} of {w}x{h}' for (h, w), n in self.sizes.most_common(3))
            raise RecordingError(
                f'topic {escaped(self.found[topics.IMAGE])}: images of different sizes (width x '
                f'height): {listing}; one recording has one size')
        return size

    def finish(self):
        """Put the parts together, rows in the order of their log times."""
        self._decode_kept()
        self._drop_goals()
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
        losses = self.file.losses + self.losses
        if losses:
            columns.damage, arrays['gap'] = describe(losses), gaps(losses)
        columns.arrays = arrays
        columns.names = list(self.names)
        if self.goals:
            columns.goal_frames = np.stack(self.goals)
        return columns

    def _drop_goals(self):
        """Take back goal pictures that are not of the size of the others, or of the camera's."""
        size = self.columns.image_size or (self.goals[0].shape[:2] if self.goals else None)
        good = np.array([goal.shape[:2] == size for goal in self.goals], bool)
        if good.all():
            return
        self.goals = [goal for goal in self.goals if goal.shape[:2] == size]
        renumbered = np.append(np.where(good, np.cumsum(good) - 1, -1), -1)  # -1 stays -1
        for logs, index in zip(self.parts['goal_log'], self.parts['goal_index'], strict=True):
            bad = (index >= 0) & (renumbered[index] < 0)
            index[:] = renumbered[index]
            self._lose(topics.GOAL_IMAGE, logs[bad], RecordingError(
                f'a goal of another size than {size[1]}x{size[0]} pixels'))

    def _lose(self, name, logs, error):
        """Note messages that cannot be used."""
        self.losses += [
            Loss(str(error), f'topic {self.found[name]}', None, log, log, _CUTS.get(name, NOTHING))
            for log in logs.tolist()]

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

    @np.errstate(over='ignore')  # absurd numbers become infinite
    def _decode_kept(self):
        for name, by_size in self.kept.items():
            for parts in by_size.values():
                numbers, logs, data = (np.concatenate(p) for p in zip(*parts, strict=True))
                for own, layout in self._groups(
                        topics.TYPES[name], data.shape[1], len(data),
                        lambda rows, width, data=data: data[rows, :width]):
                    if isinstance(layout, RecordingError):
                        self._lose(name, logs[own], layout)
                        if name == topics.GOAL_OBJECTS:  # what was said before holds no more
                            self._add_objects(
                                'goal_object', numbers[own], logs[own],
                                np.zeros(len(own), np.int64), (), np.empty((len(own), 0, 9)))
                    else:
                        self.decode[name](numbers[own], logs[own], layout, data[own])
        self.kept, self.kept_bytes = {}, 0

    def _groups(self, kind, size, count, heads, **options):
        """
        Sort messages of one size by their structure.

        :param heads: function(rows, width) -> (n, width) uint8, the first bytes of some messages.
        :return: iterator over (rows, Layout), or (rows, RecordingError) for those without one.
        """
        for start in range(0, count, _GROUP_ROWS):
            left = np.arange(start, min(start + _GROUP_ROWS, count))
            known = self.layouts.setdefault((kind, size), [])
            for layout in list(known[:_RECENT]):
                left = yield from self._match(layout, left, heads)
                if not len(left):
                    break
            while len(left):
                try:
                    layout = Layout(kind, heads(left[:1], size)[0], **options)
                except RecordingError as error:
                    self._charge(kind, _MESSAGE_FIELDS if options else size // _FIELD_BYTES)
                    yield left[:1], error
                    left = left[1:]
                    continue
                self._charge(kind, len(layout.values) + len(layout.strings))
                known.insert(0, layout)
                left = yield from self._match(layout, left, heads)
            del known[_RECENT:]

    @staticmethod
    def _match(layout, left, heads):
        """Yield the rows that a Layout fits; return the others."""
        same = layout.matches(heads(left, layout.prefix))
        if same.any():
            yield left[same], layout
        return left[~same]

    def _charge(self, kind, count):
        """Refuse files in which nearly every message, or a huge one, has its own structure."""
        self.fields += count
        most = _FREE_FIELDS + len(self.file.data) // _BYTES_PER_FIELD
        if self.fields > most:
            raise RecordingError(
                f'messages of type {kind} have more than {most} fields in all whose '
                'places differ from one to the next; no recording has so many')

    def _add(self, name, numbers, logs, **values):
        """Append values that belong to messages."""
        values |= {f'{name}_number': numbers, f'{name}_log': logs}
        for key, value in values.items():
            self.parts.setdefault(key, []).append(value)

    def _pictures(self, name, block, rows):
        """
        Yield (rows, Picture, stamps, buffers) of images of one structure; H * W * 3 bytes each.

        Instead of the last three a RecordingError where images cannot be used.
        """
        for size in np.unique(rows[:, 2]).tolist():
            own = np.flatnonzero(rows[:, 2] == size)
            starts = rows[own, 1]

            def heads(part, width, starts=starts):
                return gather(block.buffer, starts[part], width)

            for group, layout in self._groups(
                    topics.TYPES[topics.IMAGE], size, len(own), heads,
                    skip='data', same=('height', 'width', 'step')):
                try:
                    if isinstance(layout, RecordingError):
                        raise layout
                    picture = Picture.of(layout)
                except RecordingError as error:
                    self._lose(name, rows[own[group], 0], error)
                    if name == topics.GOAL_IMAGE:  # what was said before holds no more
                        self._add_goals(own[group], rows)
                    continue
                stamps = layout.stamps(heads(group, layout.prefix))
                yield own[group], picture, stamps, [
                    picture.rgb(block.buffer, start + layout.prefix)
                    for start in starts[group].tolist()]

    def _images(self, block, rows):
        stamps, buffers = np.empty(len(rows), np.int64), [None] * len(rows)
        for group, picture, group_stamps, found in self._pictures(topics.IMAGE, block, rows):
            if 0 in picture.size:
                self._lose(topics.IMAGE, rows[group, 0], RecordingError('an empty picture'))
                continue
            self.sizes[picture.size] += len(group)
            if self.columns.image_size is None:
                self.columns.image_size = picture.size
            if picture.size != self.columns.image_size:
                self._lose(topics.IMAGE, rows[group, 0], RecordingError(
                    'a picture of {1}x{0} pixels among those of {3}x{2}'.format(
                        *picture.size, *self.columns.image_size)))
                continue
            stamps[group] = group_stamps
            for i, buffer in zip(group.tolist(), found, strict=True):
                buffers[i] = buffer
        good = np.array([buffer is not None for buffer in buffers])
        self.write_frames([buffer for buffer in buffers if buffer is not None])
        self._add('frame', (self.taken + np.arange(len(rows)))[good], rows[good, 0],
                  frame_stamp=stamps[good])

    def _goal_images(self, block, rows):
        for group, picture, stamps, found in self._pictures(topics.GOAL_IMAGE, block, rows):
            index = np.full(len(group), -1)
            if 0 not in picture.size:
                index[:] = np.arange(len(group)) + len(self.goals)
                self.goals += [np.array(b).reshape(*picture.size, 3) for b in found]
            self._add_goals(group, rows, stamps, index)

    def _add_goals(self, group, rows, stamps=0, index=-1):
        """Append goal pictures; by default such that take back what was said before."""
        self._add('goal', self.taken + group, rows[group, 0],
                  goal_stamp=np.zeros(len(group), np.int64) + stamps,
                  goal_index=np.zeros(len(group), np.int64) + index)

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
        for column, name in enumerate(GRIPPER_JOINTS):
            if name in names and names.index(name) < positions.shape[1]:
                joints[:, column] = positions[:, names.index(name)]
        if not np.isnan(joints).all():
            self._add('joint', numbers, logs, joint=joints, joint_stamp=layout.stamps(data))

    def _objects(self, column, numbers, logs, layout, data):
        K = layout.counts['objects']
        names = tuple(layout.strings[f'objects[{i}].name'] for i in range(K))
        values = np.empty((len(data), K, 9))
        for i in range(K):
            values[:, i] = layout.column(
                data, *(f'objects[{i}].{path}' for path in ('u', 'v', *_POSE)))
        self._add_objects(column, numbers, logs, layout.stamps(data), names, values)

    def _add_objects(self, column, numbers, logs, stamps, names, values):
        number = self.names.setdefault(names, len(self.names))
        self._add(column, numbers, logs, **{
            f'{column}_stamp': stamps, column: values,
            f'{column}_names': np.full(len(values), number)})

    def _marks(self, numbers, logs, layout, data):
        self._add('mark', numbers, logs, mark_stamp=layout.stamps(data),
                  mark_event=layout.column(data, 'event').astype(np.int64))
        for seed in layout.column(data, 'seed').tolist():
            self.columns.marks.append((layout.strings['task'], seed, layout.strings['outcome']))


def pad_objects(parts):
    """Give all arrays (N, K, 9) the largest K, with NaN for objects that are not there."""
    K = max((part.shape[1] for part in parts), default=0)
    size = sum(part.nbytes for part in parts)
    if K * sum(len(part) for part in parts) * 72 > max(_PADDED_BYTES, _PADDING * size):
        raise RecordingError(
            f'messages of up to {K} objects among many of far fewer; no recording is like that')
    return [
        np.pad(part, ((0, 0), (0, K - part.shape[1]), (0, 0)), constant_values=np.nan)
        if part.shape[1] < K else part for part in parts]
