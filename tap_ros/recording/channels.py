# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The channels of recordings, and how messages of other kinds become those of ROS 2.

These are messages of ROS 1, and pictures of Foxglove's schemas, which its programs write as
protobuf, JSON, or as messages of ROS.
"""

import base64
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
import json
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
    """Return how a channel is read: as it is, or with messages that become those of ROS 2."""
    name, encoding = called(channel.type_name), channel.encoding
    convert: Convert | None = None
    kind = channel.type_name
    if name in PICTURES and encoding in ('protobuf', 'json', 'cdr', 'ros1'):
        kind = PICTURES[name]
        convert = partial(_picture, channel, kind)
    elif encoding == 'json' and kind in IMAGE.types:
        convert = partial(_picture, channel, kind)
    elif encoding == 'ros1' and not is_packets(channel):
        kind = _ros2_name(kind)
        convert = partial(_from_ros1, kind)
    return replace(channel, type_name=kind, encoding='cdr', schema_encoding='', schema='',
                   convert=convert) if convert else channel


def packet(channel: Channel, data: memoryview) -> bytes:
    """Return the video data of a message."""
    return bytes(_fields(channel, data)['data'])


def _from_ros1(kind: str, data: memoryview, _: int) -> memoryview:
    """Return a message of ROS 1 as one of ROS 2, whose fields are the same but for header.seq."""
    return typestore().ros1_to_cdr(data, kind)


def _ros2_name(kind: str) -> str:
    return kind.replace('/msg/', '/').replace('/', '/msg/')


def _picture(channel: Channel, kind: str, data: memoryview, log: int) -> bytes:
    """Return a picture as a message of ROS 2; without a time, the log's."""
    found = _fields(channel, data)
    time = found.get('timestamp') or found.get('header', {}).get('stamp')
    if not isinstance(time, dict):
        time = {'sec': log // 10**9, 'nanosec': log % 10**9}
    stamp = {'sec': time.get('sec', 0), 'nanosec': time.get('nanosec', time.get('nsec', 0))}
    wanted = {name for name, _ in typestore().fielddefs[kind][1]} - {'header'}
    return encode(kind, {name: value for name, value in found.items() if name in wanted}
                  | {'header': {'stamp': stamp}})


def _fields(channel: Channel, data: memoryview) -> dict[str, Any]:
    """Return the fields of a message of Foxglove's, or of a packet of video."""
    name = called(channel.type_name)
    if channel.encoding == 'json':
        found = json.loads(bytes(data))
        return found | {'data': base64.b64decode(found.get('data', ''))}
    if channel.encoding == 'protobuf':
        raw, known = read_protobuf(data), dict[str, Any]()
        text, numbers = _FIELDS[name]
        for line, number in zip(text.splitlines(), numbers):
            kind, key = line.split()
            if number in raw:
                value = raw[number][-1]
                known[key] = value if kind == 'uint32' else (
                    bytes(value) if kind == 'uint8[]' else str(value, 'utf-8'))
        if 1 in raw:
            time = read_protobuf(raw[1][-1])
            known['timestamp'] = {'sec': time.get(1, [0])[-1], 'nanosec': time.get(2, [0])[-1]}
        return known
    kind = f'foxglove_msgs/msg/{name}' if name else channel.type_name
    _register()
    if channel.encoding == 'ros1':
        data = typestore().ros1_to_cdr(data, kind)
    message = vars(decode(kind, data))
    stamp = message.get('timestamp')
    return message | {'timestamp': stamp and {'sec': stamp.sec, 'nanosec': stamp.nanosec}}


@cache
def _register() -> None:
    """Let rosbags know the types that it does not."""
    texts = {f'foxglove_msgs/msg/{name}': _HEAD + text for name, (text, _) in _FIELDS.items()}
    for kind, text in {**texts, _PACKET: _PACKET_FIELDS}.items():
        if kind not in typestore().fielddefs:
            typestore().register(get_types_from_msg(text, kind))


def read_protobuf(data: memoryview) -> dict[int, list[Any]]:
    """Return the fields of a message by number: integers, and views of what has a length."""
    found: dict[int, list[Any]] = {}
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
        found.setdefault(key >> 3, []).append(varint() if key & 7 == 0 else (
            part if key & 7 == 2 else int.from_bytes(part, 'little')))
    return found
