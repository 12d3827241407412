# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The messages of one file as arrays: one column a field, rows in the order of the log.

Nothing is cut or aligned here, so that a file can be decoded, and kept, by itself even when an
episode goes on in the next one. A message that cannot be used is left out and noted.
"""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
import json
from pathlib import Path
from typing import Any

import numpy as np
from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.errors import ImageError, RecordingError
from tap_ros.messages.images import decode_image, decode_mask, is_empty
from tap_ros.messages.joints import decode_positions, PLACE
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.messages.topics import BY_COLUMNS, COMPRESSED_TYPE, IMAGE
from tap_ros.recording.damage import describe, EVERYTHING, FAR, FRAMES, gaps, Loss, NOTHING
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.messages import decode
from tap_ros.recording.reading import Reading
from tap_ros.recording.spans import Mark
from tap_ros.robots.arm import find_joints, known_arms, MOST_JOINTS
from tap_ros.text import escaped

_ENDINGS = ('_log', '_stamp', '_names', '_event', '_index')  # of column names
_NUMBERS = {'twist': ((3,), np.float32), 'command': ((), np.float32),
            'joint': ((4,), np.float64), 'arm': ((MOST_JOINTS,), np.float64)}
# Messages that are no pictures cost time to decode: so many bytes in any file, and so many for
# each byte of it.
_FREE_STATES, _STATES_PER_BYTE = 2**24, 64
_MAX_STATE = 2**20  # bytes of one of them
_PADDED_BYTES, _PADDING = 2**28, 16  # objects may be padded to so much, or so many times theirs
# What may be missing where one is; else NOTHING.
_CUTS = {'frame': FRAMES, 'twist': FRAMES, 'command': FRAMES, 'mark': EVERYTHING}
_GOALS = ('goal', 'goal_mask')
_PICTURES = ('frame', 'mask', *_GOALS)


@dataclass
class Columns:
    """
    What one file holds; times in nanoseconds, N differs from topic to topic.

    arrays: <name>_log (N,) int64 and, where messages have a header, <name>_stamp (N,) int64, and
        goal_index, goal_mask_index (N,) int64, row of goal_frames and goal_masks, -1 for an empty
            picture
        mask_index (N,) int64, row of masks
        twist (N, 3) float32 linear; command (N,) float32 gripper opening
        joint (N, 4) float64 gripper state, NaN where unknown
        arm (N, 6) float64 rad, joints of a UR10e where the gripper's place is not told
        object, goal_object (N, K, 9) float64 u, v, pose; object_names, goal_object_names (N,)
            int64, row of names
        mark_event (N,) int64
        gap (G, 3) int64: where episodes are cut, as losses.gaps gives it
    """

    source: str  # what messages call the file
    image_size: tuple[int, int] | None = None  # (H, W); None without any image
    camera_size: tuple[int, int] | None = None  # likewise, before they were cut and scaled
    frames: np.ndarray | None = None  # (F, H, W, 3) uint8, rows belong to frame_log
    goal_frames: np.ndarray | None = None  # (G, H, W, 3) uint8
    masks: np.ndarray | None = None  # (M, H, W) uint8, of the robot; see mask_index
    goal_masks: np.ndarray | None = None  # (N, H, W) uint8
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    names: list[tuple[str, ...]] = field(default_factory=list)  # source of objects, then theirs
    marks: list[Mark] = field(default_factory=list)  # by row of mark_log
    damage: list[str] = field(default_factory=list)  # lines: what could not be used, and why

    def describe(self) -> str:
        """Return all that is not an array as JSON text."""
        return json.dumps({
            'image_size': self.image_size, 'camera_size': self.camera_size,
            'names': self.names, 'marks': self.marks, 'damage': self.damage})


def decode_file(path: str | Path, found: dict[str, str],
                write_frame: Callable[[np.ndarray], object],
                write_mask: Callable[[np.ndarray], object],
                restart: Callable[[], object], reading: Reading) -> Columns:
    """
    Read a file from front to back.

    Pictures of another size than the most of a file are left out, as are those that cannot be
    used.

    :param path: of the file.
    :param found: dict from names of columns to the file's topics, as topics.resolve gives it.
    :param write_frame: called with the pixels of one camera image after the other, (H, W, 3)
        uint8, in the order of the file; they are not to be kept.
    :param write_mask: called likewise with robot masks, (H, W) uint8.
    :param restart: called without arguments when all that was written is to be forgotten, because
        the first picture was not of the size that most are.
    :param reading: Reading; pictures, masks and pixels are cut and scaled as it says.
    :return: Columns without frames and masks; its 'frame_order' (F,) int64 puts the frames that
        were written in order.
    :raises RecordingError: when no size of pictures is that of more than half of them, or the
        file would take more memory or time than any recording of its size; it names the file.
    """
    size = None
    while True:
        decoder = _Decoder(McapFile(path), found, write_frame, write_mask, size, reading)
        try:
            for channel, log, _, data in decoder.file.messages(set(found.values())):
                decoder.take(channel.topic, log, data)
            most = decoder.most_frequent_size()
            if most == decoder.columns.camera_size and (
                    most is None or decoder.mask_size in (None, most)):
                return decoder.finish()
        except RecordingError as error:
            raise RecordingError(f'{path}: {error}') from error
        size = most
        restart()


def first_size(paths: Iterable[str | Path], found: dict[str, str]) -> tuple[int, int] | None:
    """
    Return (height, width) of the first picture of files, before it is cut; None without any.

    :param paths: of the files.
    :param found: as in decode_file.
    :raises RecordingError: when nothing can be read.
    """
    for file in map(McapFile, paths):
        for *_, data in file.messages({found['frame']}):
            compressed = _is_compressed(file, found)
            with suppress(RecordingError, ImageError):
                kind = COMPRESSED_TYPE if compressed else IMAGE.type
                height, width, _ = decode_image(decode(kind, data)).shape
                return height, width
    return None


def _is_compressed(file: McapFile, found: dict[str, str]) -> bool:
    """Tell whether the camera's pictures are compressed; known once a message has come."""
    return any(channel.type_name == COMPRESSED_TYPE for channel in file.channels.values()
               if channel.topic == found['frame'])


class _Decoder:
    """Collects the columns of a file message by message; camera images are passed on at once."""

    def __init__(self, file: McapFile, found: dict[str, str],
                 write_frame: Callable[[np.ndarray], object],
                 write_mask: Callable[[np.ndarray], object],
                 size: tuple[int, int] | None, reading: Reading) -> None:
        self.file = file
        self.found = found
        self.reading = reading
        self.due = -FAR  # ns, when the next picture is to be taken, with a rate
        self.write_frame, self.write_mask = write_frame, write_mask
        self.mask_size = size  # (H, W) of the first robot mask that was written
        self.num_masks = 0
        self.arms = known_arms()
        self.columns = Columns(str(file.path), camera_size=size)
        self.sizes: Counter[tuple[int, int]] = Counter()  # (H, W) -> camera images
        self.losses: list[Loss] = []
        self.integers: defaultdict[str, array[int]] = defaultdict(
            lambda: array('q'))  # column -> one a message
        self.numbers: defaultdict[str, array[float]] = defaultdict(
            lambda: array('d'))  # column -> as many as its rows have
        self.names: dict[tuple[str, ...], int] = {}  # tuple of object names -> number
        # name -> pictures, each with the size that it came with
        self.goals: dict[str, list[tuple[np.ndarray, tuple[int, ...]]]] = {
            'goal': [], 'goal_mask': []}
        self.state_bytes = 0  # of messages that are no pictures
        self.most_state_bytes = _FREE_STATES + _STATES_PER_BYTE * file.size
        decoders = {
            'frame': self._image, 'mask': self._mask,
            'goal': lambda *a: self._goal_picture('goal', decode_image, reading.cut.image, *a),
            'goal_mask': lambda *a: self._goal_picture(
                'goal_mask', decode_mask, reading.cut.mask, *a),
            'twist': self._twist, 'command': self._command, 'joint': self._joints,
            'mark': self._mark, 'object': lambda *a: self._objects('object', *a),
            'goal_object': lambda *a: self._objects('goal_object', *a)}
        self.decoders = defaultdict(list)  # topic -> (name, function)
        for name, topic in found.items():
            self.decoders[topic].append((name, decoders[name]))

    def take(self, topic: str, log: int, data: memoryview) -> None:
        """Take a message; note it when it cannot be used."""
        for name, decoder in self.decoders[topic]:
            state = name not in _PICTURES
            if state:
                self._charge(len(data))
            try:
                if state and len(data) > _MAX_STATE:
                    raise RecordingError(f'a message of more than {_MAX_STATE} bytes')
                kind = COMPRESSED_TYPE if (
                    name == 'frame' and self.compressed) else BY_COLUMNS[name].type
                decoder(log, decode(kind, data))
            except (RecordingError, ImageError) as error:
                self._lose(name, log, error)
                if name in _GOALS:  # what was said before holds no more
                    self._add(name, log, stamp=0, index=-1)
                elif name == 'goal_object':
                    self._add_objects('goal_object', log, 0, ('',), ())

    @cached_property
    def compressed(self) -> bool:
        """Whether the camera's pictures are compressed; known once a message has come."""
        return _is_compressed(self.file, self.found)

    def most_frequent_size(self) -> tuple[int, int] | None:
        """Return the size of more than half of the camera images, None without any."""
        if not self.sizes:
            return None
        (size, count), *_ = self.sizes.most_common(1)
        if 2 * count <= self.sizes.total():
            listing = ', '.join(f'{n} of {w}x{h}' for (h, w), n in self.sizes.most_common(3))
            raise RecordingError(
                f'topic {escaped(self.found["frame"])}: images of different sizes (width x '
                f'height): {listing}; one recording has one size')
        return size

    def finish(self) -> Columns:
        """Make arrays, rows in the order of their log times."""
        for name in _GOALS:
            self._drop_goals(name)
        columns = self.columns
        if columns.camera_size is not None:
            columns.image_size = self.reading.cut.cut_size(columns.camera_size)
        else:  # masks of nothing, whose size nothing tells
            for key in ('mask_log', 'mask_stamp', 'mask_index'):
                self.integers.pop(key, None)
        arrays = {key: np.array(column, np.int64) for key, column in self.integers.items()}
        with np.errstate(over='ignore'):  # absurd numbers become infinite
            for key, (width, dtype) in _NUMBERS.items():
                if key in self.numbers:
                    arrays[key] = np.array(self.numbers[key]).reshape(-1, *width).astype(dtype)
        for name in ('object', 'goal_object'):
            if f'{name}_log' in arrays:
                arrays[name] = pad_objects(
                    np.array(self.numbers[name]).reshape(-1, 9), arrays.pop(f'{name}_count'))
                if columns.camera_size is not None:
                    arrays[name][..., :2] = self.reading.cut.pixels(
                        arrays[name][..., :2].astype(np.float32), columns.camera_size)
        for name in [key.removesuffix('_log') for key in arrays if key.endswith('_log')]:
            order = np.argsort(arrays[f'{name}_log'], kind='stable')
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
        columns.goal_frames, columns.goal_masks = (
            np.stack([picture for picture, _ in pictures]) if pictures else None
            for pictures in self.goals.values())
        return columns

    def _drop_goals(self, name: str) -> None:
        """Take back goal pictures that are not of the size of the others, or of the camera's."""
        goals = self.goals[name]
        size = self.columns.camera_size or (goals[0][1] if goals else None)
        kept = [goal for goal in goals if goal[1] == size]
        if size is None or len(kept) == len(goals):
            return
        logs, index, number = self.integers[f'{name}_log'], self.integers[f'{name}_index'], 0
        for row, old in enumerate(index):
            if old < 0:
                continue
            good = goals[old][1] == size
            index[row], number = (number, number + 1) if good else (-1, number)
            if not good:
                self._lose(name, logs[row], RecordingError(
                    f'a goal of another size than {size[1]}x{size[0]} pixels'))
        self.goals[name] = kept

    def _lose(self, name: str, log: int, error: Exception) -> None:
        """Note a message that cannot be used."""
        self.losses.append(Loss(
            str(error), f'topic {self.found[name]}', None, log, log, _CUTS.get(name, NOTHING)))

    def _charge(self, size: int) -> None:
        """Refuse files with more than any recording of this size holds, as decoding takes time."""
        self.state_bytes += size
        if self.state_bytes > self.most_state_bytes:
            raise RecordingError(
                f'more than {self.most_state_bytes} bytes of messages that are no pictures; no '
                'recording of its size has so many')

    def _add(self, name: str, log: int, numbers: Iterable[float] = (), **integers: int) -> None:
        """Append a row to the columns of a name."""
        for key, value in {'log': log, **integers}.items():
            self.integers[f'{name}_{key}'].append(value)
        self.numbers[name].extend(numbers)

    def _image(self, log: int, message: Any) -> None:
        if not self._is_due(to_nanoseconds(message.header.stamp) or log):
            return
        pixels = decode_image(message)
        columns, size = self.columns, pixels.shape[:2]
        cut = self.reading.cut.image(pixels)
        self.sizes[size] += 1
        if columns.camera_size is None:
            columns.camera_size = size
        if size != columns.camera_size:
            raise RecordingError('a picture of {1}x{0} pixels among those of {3}x{2}'.format(
                *size, *columns.camera_size))
        self.write_frame(cut)
        self._add('frame', log, stamp=to_nanoseconds(message.header.stamp))

    def _is_due(self, time: int) -> bool:
        """Tell whether a picture of this time, ns, is taken, so that no more than the rate are."""
        if not self.reading.rate:
            return True
        period = int(1e9 / self.reading.rate)
        if self.due - 2 * period <= time < self.due - period // 4:  # else the clock was set back
            return False
        self.due = (self.due if abs(time - self.due) <= period else time) + period
        return True

    def _mask(self, log: int, message: Any) -> None:
        mask = decode_mask(message)
        # A mask may come before the first picture; its size is judged at the end.
        size = self.columns.camera_size or self.mask_size or mask.shape
        if mask.shape != size:
            raise RecordingError('a robot mask of {1}x{0} pixels among pictures of {3}x{2}'.format(
                *mask.shape, *size))
        self.mask_size = self.mask_size or mask.shape
        self.write_mask(self.reading.cut.mask(mask))
        self._add('mask', log, stamp=to_nanoseconds(message.header.stamp), index=self.num_masks)
        self.num_masks += 1

    def _goal_picture(self, name: str, read: Callable[[Any], np.ndarray],
                      cut: Callable[[np.ndarray], np.ndarray], log: int, message: Any) -> None:
        if is_empty(message):
            self._add(name, log, stamp=to_nanoseconds(message.header.stamp), index=-1)
        else:
            pixels = read(message)
            picture = np.array(cut(pixels)), pixels.shape[:2]
            self._add(name, log, stamp=to_nanoseconds(message.header.stamp),
                      index=len(self.goals[name]))
            self.goals[name].append(picture)

    def _twist(self, log: int, message: Any) -> None:
        linear = message.twist.linear
        self._add('twist', log, (linear.x, linear.y, linear.z),
                  stamp=to_nanoseconds(message.header.stamp))

    def _command(self, log: int, message: Any) -> None:
        self._add('command', log, (message.data,))

    def _joints(self, log: int, message: Any) -> None:
        known = decode_positions(message)
        if known.keys() & set(GRIPPER_JOINTS):
            self._add('joint', log, [known.get(name, np.nan) for name in GRIPPER_JOINTS],
                      stamp=to_nanoseconds(message.header.stamp))
        arm = None if known.keys() & set(PLACE) else find_joints(known, self.arms)
        if arm is not None and np.isfinite(arm).all():
            self._add('arm', log, np.pad(arm, (0, MOST_JOINTS - len(arm))),
                      stamp=to_nanoseconds(message.header.stamp))

    def _objects(self, column: str, log: int, message: Any) -> None:
        numbers: list[float] = []
        for one in message.objects:
            place, turn = one.pose.position, one.pose.orientation
            numbers += (one.u, one.v, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        names = (message.source, *(one.name for one in message.objects))
        self._add_objects(column, log, to_nanoseconds(message.header.stamp), names, numbers)

    def _add_objects(self, column: str, log: int, stamp: int, names: tuple[str, ...],
                     numbers: Sequence[float]) -> None:
        number = self.names.setdefault(names, len(self.names))
        self._add(column, log, numbers, stamp=stamp, names=number, count=len(names) - 1)

    def _mark(self, log: int, message: Any) -> None:
        self._add('mark', log, stamp=to_nanoseconds(message.header.stamp), event=message.event)
        self.columns.marks.append((message.task, message.seed, message.outcome))


def pad_objects(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """
    Give each message as many objects as the one with the most has, NaN for those not there.

    :param values: (sum of counts, 9) float64.
    :param counts: (N,) objects of each message.
    :return: (N, K, 9) float64.
    :raises RecordingError: when nearly all would be NaN.
    """
    N, K = len(counts), int(counts.max(initial=0))
    if len(values) == N * K:
        return values.reshape(N, K, 9)
    if N * K * 72 > max(_PADDED_BYTES, _PADDING * values.nbytes):
        raise RecordingError(
            f'messages of up to {K} objects among many of far fewer; no recording is like that')
    padded = np.full((N, K, 9), np.nan)
    padded[np.arange(K) < counts[:, None]] = values
    return padded
