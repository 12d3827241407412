# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is given as a recording: MCAP, or something else that is read likewise or explained.

Bags of sqlite3 and of ROS 1 are read by rosbags, as are messages of ROS 1 in MCAP files; pictures
that Foxglove's programs write as protobuf are read here. All of them arrive as messages of ROS 2.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, ExitStack
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
import re
import shlex
import shutil
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any

from mcap.writer import MCAP0_MAGIC as MAGIC
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, TypesysError
from tap_ros.errors import RecordingError
from tap_ros.messages.topics import COMPRESSED_TYPE, IMAGE
from tap_ros.recording.damage import FAR, Loss
from tap_ros.recording.mcap_file import Channel, McapFile
from tap_ros.recording.messages import decode, encode, typestore
from tap_ros.recording.metadata import bag_files, FILE_NAME, PACKED
from tap_ros.text import escaped, listing
import zstandard

VIDEOS = ('.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.h264')
_BAGS = {b'SQLite format 3\0': '.db3', b'#ROSBAG V2.0': '.bag'}  # by how a file begins
_MOST_FILES = 10000  # of a folder that are looked at
# Pictures of Foxglove's schemas: ours, and our fields by number.
_FOXGLOVE = {
    'foxglove.CompressedImage': (COMPRESSED_TYPE, {2: 'data', 3: 'format'}),
    'foxglove.RawImage': (IMAGE.type, {2: 'width', 3: 'height', 4: 'encoding', 5: 'step',
                                       6: 'data'})}
# Packets of video: the definitions of types that rosbags does not know.
_VIDEO = {
    'foxglove.CompressedVideo': '',
    'foxglove_msgs/msg/CompressedVideo':
        'builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n',
    'ffmpeg_image_transport_msgs/msg/FFMPEGPacket':
        'std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n'
        'uint8 flags\nbool is_bigendian\nuint8[] data\n'}
_DAMAGE = (SerdeError, TypesysError, AssertionError, LookupError, ValueError)
Convert = Callable[[memoryview, int], bytes | memoryview]  # message, log time


def recognise(path: Path) -> list[list[Path]] | None:
    """
    Return the bags at a path that are not MCAP: a list of lists of files, in playing order.

    :param path: of a file or folder that exists.
    :return: what open_file reads; None for what may be MCAP.
    :raises RecordingError: for what cannot be read; it says what it is, and a command that helps.
    """
    if bag := _bag(path):
        return [bag]
    if path.suffix == '.mcap' or _start(path).startswith(MAGIC):
        return None
    if path.is_dir():
        parts = sorted(part for part in path.iterdir() if part.is_dir())
        if any(map(_bag, parts)):
            return [files for part in parts if (files := _bag(part) or bag_files(part))]
        if any(next(path.glob(names), None) for names in ('*.mcap*', '*/*.mcap*')):
            return None
    if what := _what(path):
        raise RecordingError(f'{escaped(path)}: {what}')
    return None


def explain(channels: Iterable[Channel], files: Sequence[Path]) -> str:
    """Return why a bag has no camera that can be read, and a command that helps; '' if unknown."""
    for channel in channels:
        if channel.type_name in _VIDEO:
            return explain_video(channel.topic, files)
    other = sorted({channel.encoding for channel in channels} - {'cdr'})
    return f'its messages are encoded as {listing(other)}; only those of ROS are read, and ' \
        f'{listing(_FOXGLOVE)} as protobuf' if other else ''


def explain_video(topic: str, files: Sequence[Path]) -> str:
    """Return the command that makes pictures of a topic with packets of video."""
    place = files[0] if len(files) == 1 else files[0].parent
    return (f'topic {escaped(topic)} holds packets of a video; make a bag of its pictures: '
            f'{_command("import-video", place)} --image-topic {shlex.quote(escaped(topic))}')


def is_video(description: str) -> bool:
    """Tell whether the field `format` of a CompressedImage is a codec of videos."""
    return bool(re.search('h[.]?26[45]|hevc|av1|vp[89]', description.lower()))


def video_packets(files: Iterable[Path], topic: str = '') -> tuple[list[float], bytes]:
    """
    Return the video that a topic of a bag holds.

    :param files: of the bag.
    :param topic: of the packets; '': the only one.
    :return: seconds of the packets, and all of them, an elementary stream.
    :raises RecordingError: without such a topic, or where several are.
    """
    times, stream, found = list[float](), bytearray(), set[str]()
    for file in map(open_file, files):
        found |= {name for name, channel in file.topics().items() if channel.type_name in _VIDEO
                  or (name, channel.type_name) == (topic, COMPRESSED_TYPE)}
        wanted = found & {topic or name for name in found}
        if len(wanted) != 1:
            raise RecordingError(f'{escaped(file.path)}: --image-topic: expected one of '
                                 f'{listing(sorted(found)) or "packets of video, but none is"}')
        for channel, log, _, data in file.messages(wanted):
            times.append(log / 1e9)
            stream += _packet(channel, data)
    return times, bytes(stream)


def _packet(channel: Channel, data: memoryview) -> bytes:
    """Return the video data of a message."""
    if channel.encoding == 'protobuf':
        return bytes(_read_protobuf(data)[3])
    if channel.type_name not in typestore().fielddefs:
        typestore().register(get_types_from_msg(_VIDEO[channel.type_name], channel.type_name))
    return bytes(decode(channel.type_name, data).data)


def open_file(path: str | Path) -> McapFile:
    """
    Open one file of a bag.

    :param path: as find_bags returns it.
    :return: McapFile, or what has its methods topics, counts and messages and its attributes path,
        channels and losses.
    :raises RecordingError: as McapFile.
    """
    is_bag = _start(Path(path)).startswith(tuple(_BAGS))
    return RosbagFile(path) if is_bag else ConvertedFile(path)


class ConvertedFile(McapFile):
    """An MCAP file, with messages of ROS 1 and pictures of Foxglove as messages of ROS 2."""

    def __init__(self, path: str | Path) -> None:
        self._converters: dict[str, Convert] = {}  # by topic
        super().__init__(path)

    def messages(self, wanted: Collection[str]) -> Iterator[tuple[Channel, int, int, memoryview]]:
        """Yield messages as McapFile does."""
        for channel, log, publish, data in super().messages(wanted):
            convert = self._converters.get(channel.topic)
            try:
                yield channel, log, publish, memoryview(convert(data, log)) if convert else data
            except _DAMAGE as error:
                self.losses.append(Loss(f'a message that is damaged: {escaped(error)}',
                                        f'topic {escaped(channel.topic)}', None, log, log))

    def _define(self, record: Any) -> None:
        """Take notice of a schema or channel, and of how its messages become those of ROS 2."""
        super()._define(record)
        channel = self.channels.get(record.id)
        if channel is None or channel.encoding not in ('ros1', 'protobuf'):
            return
        convert: Convert
        if channel.encoding == 'ros1':
            kind = channel.type_name.replace('/msg/', '/').replace('/', '/msg/')
            convert = partial(_from_ros1, kind)
        elif channel.type_name in _FOXGLOVE:
            kind, fields = _FOXGLOVE[channel.type_name]
            convert = partial(_from_foxglove, kind, fields)
        else:
            return
        self._converters[channel.topic] = convert
        self.channels[record.id] = replace(
            channel, type_name=kind, encoding='cdr', schema_encoding='', schema='')


class RosbagFile(McapFile):
    """A bag of ROS 1, or a file of a bag that ROS 2 keeps in sqlite3."""

    def __init__(self, path: str | Path) -> None:
        self.path, self.size = path, Path(path).stat().st_size
        self.losses: list[Loss] = []
        self.channels: dict[int, Channel] = {}
        self._count = Counter[tuple[str, str]]()  # messages by topic and type
        self._converters: dict[int, Convert] = {}
        with _opened(path) as reader:
            for connection in reader.connections:
                text = connection.msgdef.data if (
                    connection.msgdef.format == MessageDefinitionFormat.MSG) else ''
                if isinstance(reader, Ros1Reader):
                    self._converters[connection.id] = partial(
                        _from_ros1, connection.msgtype)
                    text = ''
                self.channels[connection.id] = Channel(
                    connection.topic, connection.msgtype, 'cdr', 'ros2msg' if text else '', text)
                self._count[connection.topic, connection.msgtype] += connection.msgcount

    def counts(self) -> Counter[tuple[str, str]]:
        """Return the number of messages by topic and type."""
        return self._count

    def messages(self, wanted: Collection[str]) -> Iterator[tuple[Channel, int, int, memoryview]]:
        """Yield messages as McapFile does."""
        last = None
        try:
            with _opened(self.path) as reader:
                chosen = [each for each in reader.connections if each.topic in wanted]
                for connection, log, data in reader.messages(chosen) if chosen else ():
                    convert, last = self._converters.get(connection.id), min(log, FAR)
                    try:
                        found = convert(memoryview(data), log) if convert else data
                    except _DAMAGE as error:
                        self.losses.append(Loss(
                            f'a message that is damaged: {escaped(error)}',
                            f'topic {escaped(connection.topic)}', None, last, last))
                        continue
                    yield self.channels[connection.id], last, last, memoryview(found)
        except RecordingError as error:
            self.losses.append(Loss(f'all behind is lost: {error}', start=last, end=last))


@contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    """Open a reader of rosbags; its errors, and those of sqlite, become RecordingErrors."""
    is_ros1 = _start(Path(path)).startswith(b'#ROSBAG')
    with ExitStack() as stack:
        try:
            whole = _whole(Path(path), stack)
            reader = Ros1Reader(whole) if is_ros1 else Ros2Reader(whole)
            reader.open()
        except Exception as error:
            raise RecordingError(
                f'{escaped(path)}: cannot be read: {escaped(error)}'
                + '; if its recorder was killed, `rosbag reindex` mends it' * is_ros1) from error
        try:
            yield reader
        except Exception as error:
            raise RecordingError(escaped(error)) from error
        finally:
            reader.close()


def _whole(path: Path, stack: ExitStack) -> Path:
    """
    Return a file that rosbags reads whole; what is beside it stays as it is.

    rosbags takes neither what sqlite3 wrote beside a file whose recorder was killed, nor a file
    without metadata that is packed. Both are made whole in a copy.

    :param path: of the file.
    :param stack: removes the copy in the end.
    :raises RecordingError: without room for it.
    """
    beside, is_packed = sqlite_logs(path), path.suffix == PACKED
    if not beside and not is_packed:
        return path
    try:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix='tap_ros_')))
        copy = folder / path.name.removesuffix(PACKED)
        for file in (*beside, *(() if is_packed else (path,))):
            shutil.copyfile(file, folder / file.name)
        if is_packed:
            with open(path, 'rb') as stream, open(copy, 'wb') as out:
                shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(
                    stream, read_across_frames=True), out)
    except OSError as error:
        raise RecordingError(f'a copy is needed and cannot be made ({error.strerror}); let TMPDIR '
                             'name a folder with space for it') from error
    if beside:
        with closing(sqlite3.connect(copy)) as base:
            base.execute('SELECT count(*) FROM sqlite_master').fetchall()  # rolls back
            base.execute('PRAGMA journal_mode=DELETE').fetchall()  # takes over what -wal holds
    return copy


def sqlite_logs(path: Path) -> list[Path]:
    """Return the files beside one of sqlite3 that hold a part of what was written to it."""
    logs = [path.with_name(path.name + end) for end in ('-wal', '-journal')]
    return [log for log in logs if log.is_file() and log.stat().st_size]


def _from_ros1(kind: str, data: memoryview, _: int) -> memoryview:
    """Return a message of ROS 1 as one of ROS 2, whose fields are the same but for header.seq."""
    return typestore().ros1_to_cdr(data, kind)


def _from_foxglove(kind: str, fields: dict[int, str], data: memoryview, log: int) -> bytes:
    """Return a picture of foxglove's schemas as a message of ROS 2; without a time, the log's."""
    found = _read_protobuf(data)
    time = _read_protobuf(found[1]) if 1 in found else {1: log // 10**9, 2: log % 10**9}
    message = {name: found[number] for number, name in fields.items() if number in found}
    for name in ('format', 'encoding'):
        if name in message:
            message[name] = bytes(message[name]).decode()
    if 'data' in message:
        message['data'] = bytes(message['data'])
    stamp = {'sec': time.get(1, 0), 'nanosec': time.get(2, 0)}
    return encode(kind, message | {'header': {'stamp': stamp}})


def _read_protobuf(data: memoryview) -> dict[int, Any]:
    """Return the fields of a message by number: integers, and views of what has a length."""
    found: dict[int, Any] = {}
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            value |= (data[at] & 127) << shift
            at, shift = at + 1, shift + 7
            if data[at - 1] < 128:
                return value

    while at < len(data):
        key = varint()
        size = {0: 0, 1: 8, 5: 4}.get(key & 7, -1)
        if key & 7 == 2:
            size = varint()
        if size < 0 or at + size > len(data):
            raise ValueError('no protobuf message')
        part, at = data[at:at + size], at + size
        found[key >> 3] = varint() if key & 7 == 0 else (
            part if key & 7 == 2 else int.from_bytes(part, 'little'))
    return found


def natural(path: Path) -> list[int | str]:
    """Return what sorts part_10 behind part_2."""
    return [int(part) if part.isdigit() else part for part in re.split(r'(\d+)', str(path))]


def _bag(path: Path) -> list[Path] | None:
    """Return the files of a bag that rosbags reads, in playing order; None for anything else."""
    if path.is_file():
        return [path] if _start(path).startswith(tuple(_BAGS)) else None
    named = {file.name.removesuffix(PACKED): file for end in _BAGS.values()
             for kind in (end + PACKED, end) for file in path.glob(f'*{kind}')}
    found = [file for file in sorted(named.values(), key=natural)
             if _start(file).startswith(tuple(_BAGS))]
    if not any(path.glob('*.mcap*')):
        return found or None
    if found and not (path / FILE_NAME).exists():  # which says what belongs to the bag
        raise RecordingError(
            f'{escaped(path)}: holds .mcap files and {listing([file.name for file in found])}, '
            'which are no parts of one bag; give the files one by one, or move those of a bag '
            'into a folder of its own')
    return None


def _what(path: Path) -> str:
    """Return what something is that is no bag, and the command that makes one; '' if unknown."""
    for folder in (path, *path.absolute().parents[:4]):
        if (folder / 'meta' / 'info.json').is_file():
            return _advice('LeRobot data', 'import-lerobot', folder)
    if path.name.endswith('.zarr.zip') or any((path / name).is_file() for name in (
            '.zgroup', '.zarray', '.zattrs', 'zarr.json')):
        return _advice('a zarr store', 'import-arrays', path)
    for file in (path, *(islice(path.rglob('*'), _MOST_FILES) if path.is_dir() else ())):
        if '.tfrecord' in file.name:
            return _advice('TFRecord files, as of RLDS', 'import-tfrecord', path)
        if file.suffix.lower() in VIDEOS and file.is_file():
            return _advice('video', 'import-video', path)
        if file.is_file() and _start(file).startswith(b'\x89HDF'):
            return _advice('HDF5, as of ALOHA and robomimic', 'import-arrays', path)
    return ''


def _advice(what: str, command: str, place: Path) -> str:
    return f'no recording of ROS, but {what}; make one of it: {_command(command, place)}'


def _command(name: str, place: Path) -> str:
    return f'python -m tap_ros {name} {shlex.quote(escaped(place, 400))} --out BAG'


def _start(path: Path) -> bytes:
    """Return how a file begins, unpacked; nothing of what is no file."""
    try:
        if path.is_file():  # opening a FIFO would wait for its writer
            with open(path, 'rb') as stream:
                start = stream.read(16)
                if not start.startswith(zstandard.FRAME_HEADER):
                    return start
                stream.seek(0)
                return zstandard.ZstdDecompressor().stream_reader(stream).read(16)
    except (OSError, zstandard.ZstdError):
        pass  # who reads it says why
    return b''
