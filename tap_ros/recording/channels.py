# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The channels of recordings, and how messages of other kinds become those of ROS 2.

These are pictures and video of Foxglove's schemas, which its programs write as protobuf or as
messages of ROS 2.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
import re
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, TypesysError
from tap_ros.errors import RecordingError
from tap_ros.messages.topics import COMPRESSED_TYPE, IMAGE
from tap_ros.recording.messages import decode, encode, typestore

DAMAGE = (SerdeError, TypesysError, AssertionError, LookupError, ValueError, TypeError,
          AttributeError, OverflowError, RecordingError)  # of messages that cannot be converted
Convert = Callable[[memoryview, int], bytes | memoryview]  # message, log time
PICTURES = {'CompressedImage': COMPRESSED_TYPE, 'RawImage': IMAGE.type}
_HEAD = 'builtin_interfaces/Time timestamp\nstring frame_id\n'
_FIELDS = {  # fields after the head, and the numbers that protobuf gives them
    'CompressedImage': ('uint8[] data\nstring format\n', (2, 3)),
    'RawImage': ('uint32 width\nuint32 height\nstring encoding\nuint32 step\nuint8[] data\n',
                 (2, 3, 4, 5, 6)),
    'CompressedVideo': ('uint8[] data\nstring format\n', (3, 4))}
_PACKET = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'
_PACKET_FIELDS = ('std_msgs/Header header\nint32 width\nint32 height\nstring encoding\n'
                  'uint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data\n')


@dataclass(frozen=True)
class Channel:
    """A topic in a file; `convert` makes messages of ROS 2 of those that are none."""

    topic: str
    type_name: str
    encoding: str  # of messages; 'cdr' is all we read
    schema_encoding: str = ''  # 'ros2msg' when schema is the text of the definition
    schema: str = ''
    convert: Convert | None = field(default=None, compare=False)


def called(type_name: str) -> str:
    """Return which of Foxglove's schemas a type is, by any of their spellings; '' if none."""
    found = re.fullmatch(r'foxglove(?:_msgs)?(?:\.|::|/)(?:msg(?:::|/))?(\w+)', type_name)
    return found[1] if found and found[1] in _FIELDS else ''


def is_packets(channel: Channel) -> bool:
    """Tell whether the messages are packets of video."""
    return channel.type_name == _PACKET or called(channel.type_name) == 'CompressedVideo'


def converted(channel: Channel) -> Channel:
    """Return how a channel is read: as it is, or with pictures that become those of ROS 2."""
    kind = PICTURES.get(called(channel.type_name))
    if kind is None or channel.encoding not in ('protobuf', 'cdr'):
        return channel
    return Channel(channel.topic, kind, 'cdr', convert=partial(_picture, channel, kind))


def packet(channel: Channel, data: memoryview) -> bytes:
    """Return the video data of a message."""
    return bytes(_fields(channel, data)['data'])


def _picture(channel: Channel, kind: str, data: memoryview, log: int) -> bytes:
    """Return a picture as a message of ROS 2; without a time, the log's."""
    found = _fields(channel, data)
    stamp = found.get('timestamp') or {'sec': log // 10**9, 'nanosec': log % 10**9}
    wanted = {name for name, _ in typestore().fielddefs[kind][1]}
    return encode(kind, {name: value for name, value in found.items() if name in wanted}
                  | {'header': {'stamp': stamp}})


def _fields(channel: Channel, data: memoryview) -> dict[str, Any]:
    """Return the fields of a message of Foxglove's, or of a packet of video."""
    name = called(channel.type_name)
    if channel.encoding == 'protobuf':
        raw, known = read_protobuf(data), dict[str, Any]()
        text, numbers = _FIELDS[name]
        for line, number in zip(text.splitlines(), numbers):
            kind, key = line.split()
            if number in raw:
                value = raw[number][-1]
                known[key] = str(value, 'utf-8') if kind == 'string' else value
        if 1 in raw:
            time = read_protobuf(raw[1][-1])
            known['timestamp'] = {'sec': time.get(1, [0])[-1], 'nanosec': time.get(2, [0])[-1]}
        return known
    _register()
    message = vars(decode(f'foxglove_msgs/msg/{name}' if name else channel.type_name, data))
    stamp = message.get('timestamp')
    return message | {'timestamp': stamp and {'sec': stamp.sec, 'nanosec': stamp.nanosec}}


@cache
def _register() -> None:
    """Let rosbags know the types that it does not."""
    texts = {f'foxglove_msgs/msg/{name}': _HEAD + text for name, (text, _) in _FIELDS.items()}
    for kind, text in {**texts, _PACKET: _PACKET_FIELDS}.items():
        if kind not in typestore().fielddefs:
            typestore().register(get_types_from_msg(text, kind))


def read_protobuf(data: bytes | memoryview) -> dict[int, list[Any]]:
    """Return the fields of a message by number: integers, and bytes of what has a length."""
    from google.protobuf.empty_pb2 import Empty  # type: ignore[import-untyped]  # few need it
    from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
    from google.protobuf.unknown_fields import UnknownFieldSet  # type: ignore[import-untyped]
    found: dict[int, list[Any]] = {}
    try:
        for one in UnknownFieldSet(Empty.FromString(bytes(data))):
            found.setdefault(one.field_number, []).append(one.data)
    except DecodeError as error:
        raise ValueError('no protobuf message') from error
    return found
