# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The messages of one file as arrays: a row a message, in the order in which they were written.

Nothing is cut or aligned here, so that a file can be decoded, and kept, by itself even when an
episode goes on in the next one. A message that cannot be used is left out and noted.
"""

from array import array
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
import json
from typing import Any
import zlib

import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS, MOST_SIGNALS
from tap_ros.base.errors import ImageError, RecordingError
from tap_ros.base.text import escaped
from tap_ros.images.crop import CENTRE
from tap_ros.messages.images import decode_image, decode_mask, is_empty
from tap_ros.messages.joints import decode_positions, PLACE
from tap_ros.messages.stamps import PROOF, to_nanoseconds
from tap_ros.messages.topics import BY_COLUMNS, IMAGE
from tap_ros.recording.defects import Defect, describe, FAR, gaps
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.messages import decode
from tap_ros.recording.reading import Reading
from tap_ros.recording.views import first_return, look
from tap_ros.robots.arm import find_joints, known_arms, MOST_JOINTS

PICTURES = ('frame', 'mask', 'goal', 'goal_mask')
WIDTHS = {'frame': 1, 'twist': 3, 'command': 1, 'period': 1, 'joint': 4, 'arm': MOST_JOINTS,
          'object': 9, 'goal_object': 9, 'signal': 1}  # of the values of a message, or of each
# object or signal in it
NAMED = ('object', 'goal_object', 'signal')  # whose index is the number of the names
NAMES = (*PICTURES, *list(WIDTHS)[1:], 'mark')
_GOALS = ('goal', 'goal_mask', 'goal_object')
_CUTTING = ('twist', 'command', 'mark')  # without one of them an episode is no longer known
_NEAR = 8  # pictures
_PERIODS = 0.001, 10.0  # s, of control periods that are believed
_MAX_BYTES = 2**20  # of a message that is no picture
Mark = tuple[str, int, str]  # task, seed, outcome


@dataclass
class Columns:
    """
    What one file holds; times in nanoseconds, N differs from name to name.

    arrays: <name> (N, 4) int64 log time, stamp (0: none), place in the file, and an index: row of
        the pictures (-1: empty), number of the names of objects, or event of a mark; and
        frame_values (N, 1) float64 checksum of the message
        twist_values (N, 3) float64 linear; period_values (N, 1) s, of _PERIODS, by which they are
        multiplied; command_values (N, 1) gripper opening
        joint_values (N, 4) gripper state, NaN where unknown
        arm_values (N, MOST_JOINTS) rad, of an arm where the gripper's place is not told
        object_values, goal_object_values (sum of objects, 9) u, v, pose
        signal_values (sum of signals, 1)
        gap (G, 2) int64: where episodes are cut, as defects.gaps gives it
    """

    source: str  # what messages call the file
    image_size: tuple[int, int] | None = None  # (H, W); None without any image
    camera_size: tuple[int, int] | None = None  # of most, before they were cut and scaled
    pictures: dict[str, np.ndarray] = field(default_factory=dict)  # (N, H, W, 3) or (N, H, W)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    names: list[tuple[str, ...]] = field(default_factory=list)  # source of objects, then theirs;
    # '', then those of signals
    marks: list[Mark] = field(default_factory=list)  # by row of mark
    damage: list[str] = field(default_factory=list)  # lines: what could not be used, and why
    shapes: dict[str, list[int]] = field(default_factory=dict)  # of pictures, by name
    topics: dict[str, str] = field(default_factory=dict)  # by name

    def logs(self, names: Iterable[str]) -> np.ndarray:
        """Return the log times of the messages of some names, (N,) int64."""
        return np.concatenate([np.empty(0, np.int64), *(
            self.arrays[name][:, 0] for name in names if name in self.arrays)])

    def describe(self) -> str:
        """Return all that is not an array as JSON text."""
        return json.dumps({key: value for key, value in vars(self).items()
                           if key not in ('source', 'pictures', 'arrays')})


@dataclass
class Track:
    """The messages of one name in files that follow each other; N of them."""

    log: np.ndarray  # (N,) int64, ns
    stamp: np.ndarray  # (N,) int64, ns
    order: np.ndarray  # (N,) int64: increases as they were written, over all names
    index: np.ndarray  # (N,) int64, see Columns
    file: np.ndarray  # (N,) int64, index into the parts
    first: np.ndarray  # (N,) int64, row of values, the first of several objects
    values: np.ndarray  # (M, width) float64

    def __len__(self) -> int:
        return len(self.log)

    def take(self, rows: np.ndarray) -> 'Track':
        """Return some of the messages."""
        return Track(self.log[rows], self.stamp[rows], self.order[rows], self.index[rows],
                     self.file[rows], self.first[rows], self.values)

    def picked(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the values of some messages, (N, width)."""
        return self.values[self.first[rows]]


def decode_file(file: McapFile, found: Mapping[str, str],
                write: Callable[[str, np.ndarray], object], reading: Reading) -> Columns:
    """
    Read a file from front to back.

    Pictures of another size than the first one are left out, as are those that cannot be used.

    :param found: names of columns by topic, the camera's first, see topic_choice.Choice.
    :param write: called with the name, one of PICTURES, and the pixels of one picture after the
        other, uint8, in the order of the file; they are not to be kept.
    :param reading: Reading; pictures, masks and pixels are cut and scaled as it says.
    :return: Columns without pictures.
    :raises RecordingError: when no more than half of the pictures are of that size, or they are of
        several cameras by their headers; it names the file.
    """
    decoder = _Decoder(file, found, write, reading)
    try:
        for channel, log, _, data in file.messages(found):
            if channel.type_name in BY_COLUMNS[found[channel.topic]].types:
                decoder.take(channel.topic, channel.type_name, log, data)
        decoder.check_sizes()
        decoder.check_cameras()
    except RecordingError as error:
        raise RecordingError(f'{file.path}: {error}') from error
    return decoder.finish()


def first_size(file: McapFile, topic: str) -> tuple[int, int] | None:
    """Return (height, width) of the first picture of a topic, before it is cut; None: of none."""
    for channel, *_, data in file.messages({topic}):
        if channel.type_name in IMAGE.types:
            with suppress(RecordingError, ImageError):
                height, width, _ = decode_image(decode(channel.type_name, data)).shape
                return height, width
    return None


class _Decoder:
    """Collects the columns of a file message by message; pictures are passed on at once."""

    def __init__(self, file: McapFile, found: Mapping[str, str],
                 write: Callable[[str, np.ndarray], object], reading: Reading) -> None:
        self.file, self.found, self.write, self.reading = file, found, write, reading
        self.first = first_size(file, next(iter(found)))  # (H, W) of the first camera image
        self.size: tuple[int, int] | None = None  # that pictures must have, by _alike
        self.columns = Columns(
            str(file.path), topics={name: topic for topic, name in found.items()})
        self.sizes: Counter[tuple[int, int]] = Counter()  # (H, W) -> camera images
        self.defects: list[Defect] = []
        self.order = 0  # messages so far
        self.rows: defaultdict[str, array[int]] = defaultdict(lambda: array('q'))
        self.values: defaultdict[str, array[float]] = defaultdict(lambda: array('d'))
        self.names: dict[tuple[str, ...], int] = {}  # tuple of object names -> number
        self.written: Counter[str] = Counter()  # pictures by name
        self.arms = known_arms()
        self.stamp = 0  # of the newest camera image
        self.looks = bytearray()  # of the camera images, see views.look
        self.cameras: deque[tuple[str, tuple[int, int]]] = deque(maxlen=_NEAR)  # of the newest
        self.returns: Counter[tuple[str, tuple[int, int]]] = Counter()  # to another camera
        self.due = [-FAR, -FAR]  # ns, stamp and log time when the next one is to be taken
        self.decoders: dict[str, Callable[[str, int, Any], object]] = {
            **dict.fromkeys(PICTURES, self._picture), 'twist': self._twist,
            'command': lambda name, log, message: self._add(name, log, 0, 0, (message.data,)),
            'period': self._period, 'joint': self._joints, 'mark': self._mark,
            'signal': self._signals, 'object': self._objects, 'goal_object': self._objects}

    def take(self, topic: str, kind: str, log: int, data: memoryview) -> None:
        """Take a message of a type; note it when it cannot be used."""
        name = self.found[topic]
        self.order += 1
        try:
            if name not in PICTURES and len(data) > _MAX_BYTES:
                raise RecordingError(f'a message of more than {_MAX_BYTES} bytes')
            self.decoders[name](name, log, decode(kind, data))
        except (RecordingError, ImageError) as error:
            self.defects.append(
                Defect(str(error), f'topic {topic}', None, log, log, name in _CUTTING))
            if name in _GOALS:  # what was said before holds no more
                self._add(name, log, 0, self._number(('',)) if name == 'goal_object' else -1)

    def check_sizes(self) -> None:
        """Refuse pictures of several sizes of which the first is not that of more than half."""
        alike = {size: count for size, count in self.sizes.items()
                 if self._alike(size) == self.size}
        if 2 * sum(alike.values()) <= self.sizes.total() and self.sizes:
            listing = ', '.join(f'{n} of {w}x{h}' for (h, w), n in self.sizes.most_common(3))
            raise RecordingError(
                f'images of different sizes (width x height): {listing}; one recording has one '
                'size, or say by --crop and --size which square part of them is used')
        self.columns.camera_size = max(alike, key=alike.__getitem__, default=None)

    def check_cameras(self) -> None:
        """Refuse pictures whose frame_ids, or sizes, alternate."""
        if self.returns.total() > PROOF:
            listing = ', '.join(f'frame_id {escaped(frame)} ({w}x{h})' for frame, (h, w)
                                in sorted(self.returns))
            raise RecordingError(
                f'topic {escaped(self.columns.topics["frame"])}: pictures of several cameras '
                f'alternate: {listing}; start each camera with a name of its own, and record anew')

    def finish(self) -> Columns:
        """Make arrays."""
        columns, cut = self.columns, self.reading.cut
        if columns.camera_size is not None:
            columns.image_size = cut.cut_size(columns.camera_size)
        else:  # masks of nothing, whose size nothing tells
            self.rows.pop('mask', None)
        columns.arrays = {
            name: np.array(rows, np.int64).reshape(-1, 4) for name, rows in self.rows.items()} | {
            f'{name}_values': np.array(self.values[name]).reshape(-1, width)
            for name, width in WIDTHS.items() if name in self.rows}
        for name in ('object', 'goal_object'):
            if name in self.rows and columns.camera_size is not None:
                pixels = columns.arrays[f'{name}_values'][:, :2]
                with np.errstate(over='ignore'):  # absurd numbers become infinite
                    pixels[:] = cut.pixels(pixels.astype(np.float32), columns.camera_size)
        defects = self.file.defects + self.defects
        if defects:
            columns.damage, columns.arrays['gap'] = describe(defects), gaps(defects)
        if (first := first_return(self.looks)) is not None:
            columns.damage.append(
                f'topic {escaped(columns.topics["frame"])}: from picture {first} on two views '
                'alternate, as where several cameras were started with one name; if so, do not '
                'learn from it: start each camera with a name of its own, and record anew')
        columns.names = list(self.names)
        columns.shapes = {
            name: [self.written[name], *shape] for name, shape in columns.shapes.items()}
        return columns

    def _alike(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return a size that is the same for pictures which can stand beside each other."""
        cut = self.reading.cut
        return cut.cut_size(size) if cut.part in ('', CENTRE) else size

    def _add(self, name: str, log: int, stamp: int, index: int = 0,
             values: Iterable[float] = ()) -> None:
        """Append a row to the columns of a name."""
        self.rows[name].extend((log, stamp, self.order, index))
        self.values[name].extend(values)

    def _picture(self, name: str, log: int, message: Any) -> None:
        stamp, values = to_nanoseconds(message.header.stamp), ()
        if name in _GOALS and is_empty(message):
            return self._add(name, log, stamp, -1)
        if name == 'frame':
            values, before, self.stamp = (zlib.crc32(message.data),), self.stamp, stamp
            if not self._is_due((stamp, log), stamp in (0, before)):
                return None
        masks = name in ('mask', 'goal_mask')
        pixels = decode_mask(message) if masks else decode_image(message)
        size, cut = pixels.shape[:2], self.reading.cut
        part = cut.mask(pixels) if masks else cut.image(pixels)
        if name == 'frame':
            self.sizes[size] += 1
        self.size = self.size or self._alike(self.first or size)
        if self._alike(size) != self.size:
            raise RecordingError('a picture of {1}x{0} pixels among those of {3}x{2}'.format(
                *size, *self.size))
        if name == 'frame':
            self._take_due((stamp, log))
            self._note_camera(message.header.frame_id, size, part)
        self._add(name, log, stamp, self.written[name], values)
        self.written[name] += 1
        self.columns.shapes[name] = list(part.shape)
        self.write(name, part)
        return None

    def _note_camera(self, frame_id: str, size: tuple[int, int], part: np.ndarray) -> None:
        """Note of which camera a picture is, and what it shows."""
        shown = look(part)
        camera = (frame_id or (self.cameras[-1][0] if self.cameras else ''), size)
        if (camera in self.cameras and camera != self.cameras[-1]
                and self.looks[-len(shown):] != shown):
            self.returns[camera] += 1
        self.cameras.append(camera)
        self.looks += shown

    def _is_due(self, times: tuple[int, int], by_log: bool) -> bool:
        """
        Return whether a picture is taken, so that no more than the rate are.

        :param times: its stamp and log time, ns.
        :param by_log: its stamp tells nothing.
        """
        if not self.reading.rate:
            return True
        period, time, due = int(1e9 / self.reading.rate), times[by_log], self.due[by_log]
        return not due - 2 * period <= time < due - period // 4  # else the clock was set back

    def _take_due(self, times: tuple[int, int]) -> None:
        """Say when the next picture is due, after one that was taken."""
        if self.reading.rate:
            period = int(1e9 / self.reading.rate)
            self.due = [(due if abs(time - due) <= period else time) + period
                        for time, due in zip(times, self.due)]

    def _twist(self, name: str, log: int, message: Any) -> None:
        linear = message.twist.linear
        self._add(name, log, to_nanoseconds(message.header.stamp), 0,
                  (linear.x, linear.y, linear.z))

    def _period(self, name: str, log: int, message: Any) -> None:
        if not _PERIODS[0] <= message.data <= _PERIODS[1]:
            raise RecordingError(f'a control period of {message.data:g} s')
        self._add(name, log, 0, 0, (message.data,))

    def _joints(self, name: str, log: int, message: Any) -> None:
        known, stamp = decode_positions(message), to_nanoseconds(message.header.stamp)
        if known.keys() & set(GRIPPER_JOINTS):
            self._add(name, log, stamp, 0, [known.get(joint, np.nan) for joint in GRIPPER_JOINTS])
        arm = None if known.keys() & set(PLACE) else find_joints(known, self.arms)
        if arm is not None and np.isfinite(arm).all():
            self._add('arm', log, stamp, 0, np.pad(arm, (0, MOST_JOINTS - len(arm))))

    def _signals(self, name: str, log: int, message: Any) -> None:
        names, values = tuple(message.name), np.asarray(message.position, float)
        if len(values) != len(names) or len(names) > MOST_SIGNALS:
            raise RecordingError(f'{len(values)} numbers with {len(names)} names; expected as '
                                 f'many, at most {MOST_SIGNALS}')
        self._add(name, log, to_nanoseconds(message.header.stamp), self._number(
            ('', *names)), values.tolist())

    def _objects(self, name: str, log: int, message: Any) -> None:
        numbers: list[float] = []
        for one in message.objects:
            place, turn = one.pose.position, one.pose.orientation
            numbers += (one.u, one.v, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        self._add(name, log, to_nanoseconds(message.header.stamp), self._number(
            (message.source, *(one.name for one in message.objects))), numbers)

    def _number(self, names: tuple[str, ...]) -> int:
        """Return the number of the names of objects."""
        return self.names.setdefault(names, len(self.names))

    def _mark(self, name: str, log: int, message: Any) -> None:
        self._add(name, log, to_nanoseconds(message.header.stamp), message.event)
        self.columns.marks.append((message.task, message.seed, message.outcome))
