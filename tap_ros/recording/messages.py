# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
ROS messages without ROS: their definitions and their bytes (CDR), by rosbags.

rosbags knows the types of Jazzy; ours stand here, so that recordings are written and read where
tap_msgs is not installed. Others are looked up in the ROS installation, as rosbag2 does.
"""

from contextlib import suppress
from functools import cache
import os
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, get_typestore, Stores, TypesysError
from rosbags.typesys.store import Typestore
from tap_ros.base.errors import RecordingError
import zstandard

DEFINITIONS = {
    'tap_msgs/msg/CommandRefused': 'std_msgs/Header header\nstring message\n',
    'tap_msgs/msg/Episode': """
uint8 START=0
uint8 END=1
std_msgs/Header header
uint8 event
string task
uint64 seed
string outcome
""",
    'tap_msgs/msg/ObjectState': """
string name
float64 u
float64 v
geometry_msgs/Pose pose
""",
    'tap_msgs/msg/ObjectStates': """
string SOURCE_GROUND_TRUTH="ground_truth"
string SOURCE_TRACKED="tracked"
std_msgs/Header header
string source
ObjectState[] objects
string STATE_SEEN="seen"
string STATE_HIDDEN="hidden"
string STATE_UNSURE="unsure"
string STATE_LOST="lost"
string[] states
float64[] confidence
""",
    'tap_msgs/msg/Subgoal': """
std_msgs/Header header
sensor_msgs/Image image
string[] object_names
sensor_msgs/Image[] object_maps
geometry_msgs/Point[] expected_pixels
""",
}
EARLIER = {  # what recordings of an earlier definition hold
    'tap_msgs/msg/ObjectStates': ('tap_msgs/msg/EarlierObjectStates', """
std_msgs/Header header
string source
ObjectState[] objects
""")}
_MAX_SCHEMA = 2**16  # characters of a recorded definition; the longest in use have some thousands
_UNREADABLE = (TypesysError, AssertionError, ValueError, LookupError)  # definitions
_NUMBERS = {'bool': np.bool_, 'byte': np.uint8, 'char': np.uint8}  # else the name is numpy's


@cache
def typestore() -> Typestore:
    """Return rosbags' type store with the types of Jazzy and ours; takes 0.1 s the first time."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in (*DEFINITIONS.items(), *EARLIER.values()):
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


def encode(type_name: str, message: dict[str, Any]) -> bytes:
    """
    Serialize a message.

    :param type_name: for example 'sensor_msgs/msg/JointState'.
    :param message: dict by field name, nested; what is left out is 0, '' or empty.
    :return: bytes (CDR) with the 4-byte encapsulation header.
    :raises TypeError: for a field that the type does not have.
    """
    return bytes(typestore().serialize_cdr(_build(type_name, message), type_name))


def decode(type_name: str, data: bytes | memoryview) -> Any:
    """
    Read one message.

    :param type_name: for example 'sensor_msgs/msg/JointState'.
    :param data: bytes-like, with the encapsulation header, not compressed.
    :return: the message, its fields as attributes; arrays of numbers are views of the data.
    :raises RecordingError: when the bytes are not such a message.
    """
    if data[:4] == zstandard.FRAME_HEADER:
        raise RecordingError('damaged message: it does not unpack, or to too much')
    for end in (len(data), *range(len(data) - 4, len(data) - 20, -4)):
        try:
            return typestore().deserialize_cdr(data[:end], type_name)
        except SerdeError as error:
            # What rclpy.serialization writes has some bytes too many, where lists are empty.
            if 'size mismatch' in str(error) and end > len(data) - 16:
                continue
            if type_name in EARLIER:
                with suppress(SerdeError):
                    return typestore().deserialize_cdr(data, EARLIER[type_name][0])
            raise RecordingError(f'damaged message: {error}') from error
    raise AssertionError('not reached')


@cache
def schema_text(type_name: str) -> str:
    """
    Return the ros2msg schema of a message type: its definition and those of all types within.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    :raises RecordingError: when a definition is neither built in nor in the ROS installation.
    """
    _look_up(type_name)
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """
    Return ROS 2's hash (REP 2011) of a message type.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    :raises RecordingError: as schema_text.
    """
    _look_up(type_name)
    return typestore().hash_rihs01(type_name)


@cache
def check_schema(type_name: str, text: str) -> None:
    """
    Accept the schema of a recording if its messages can be read with our definitions.

    :param type_name: for example 'tap_msgs/msg/Episode'.
    :param text: ros2msg, as schema_text gives it; with comments or without. One that cannot be
        read, as of a recorder that did not find the definition, says nothing.
    :raises RecordingError: when fields differ; it names the type and both lists of fields.
    """
    types: dict[str, Any] = {}
    with suppress(*_UNREADABLE):
        if len(text) <= _MAX_SCHEMA:
            types = get_types_from_msg(text.replace('\r\n', '\n'), type_name)
    known = typestore().fielddefs
    for name in types.keys() & known.keys():
        theirs, ours = (', '.join(field for field, _ in fields[name][1])
                        for fields in (types, known))
        if list(types[name][1]) != list(known[name][1])[:len(types[name][1])]:
            raise RecordingError(
                f'message type {name}: recorded with the fields {theirs}; expected {ours}')


def _look_up(type_name: str) -> None:
    """Read definitions that rosbags does not know from the ROS installation."""
    found: dict[str, Any] = {}
    store, waiting = typestore(), [type_name]
    while waiting:
        name = waiting.pop()
        if name in store.fielddefs or name in found:
            continue
        package, _, kind = name.partition('/msg/')
        places = (Path(prefix, 'share', package, 'msg', f'{kind}.msg') for prefix in filter(
            None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)))
        path = next(filter(Path.is_file, places), None)
        if path is None:
            raise RecordingError(
                f'message type {name}: no definition found; built in are those of ROS 2 Jazzy '
                f'and {", ".join(sorted(DEFINITIONS))}. For others source the ROS 2 workspace '
                'that has it (AMENT_PREFIX_PATH)')
        try:
            found |= get_types_from_msg(path.read_text(), name)
        except _UNREADABLE as error:
            raise RecordingError(f'message type {name}: {path} cannot be read') from error
        for _, part in found[name][1]:  # what its fields are of, or arrays of
            kind, detail = part[1][0] if part[0] in (
                Nodetype.ARRAY, Nodetype.SEQUENCE) else part
            if kind == Nodetype.NAME:
                waiting.append(detail)
    if found:
        store.register(found)


def _build(type_name: str, values: dict[str, Any]) -> Any:
    """Return a message of rosbags' from a nested dict."""
    store = typestore()
    known = {name: _value(kind, detail, values.get(name))
             for name, (kind, detail) in store.fielddefs[type_name][1]}
    return store.types[type_name](**(values | known))


def _value(kind: Nodetype, detail: Any, value: Any) -> Any:
    """Return the value of a field, 0, '' or empty for None."""
    if kind == Nodetype.NAME:
        return _build(detail, value or {})
    if kind == Nodetype.BASE:
        return value if value is not None else '' if detail[0] == 'string' else 0
    array, ((kind, detail), count) = kind, detail
    count = count if array == Nodetype.ARRAY else 0
    if kind == Nodetype.NAME or detail[0] == 'string':
        return [_value(kind, detail, one) for one in ([None] * count if value is None else value)]
    if isinstance(value, bytes):
        return np.frombuffer(value, np.uint8)
    if value is None:
        value = np.zeros(count)
    return np.ascontiguousarray(value, _NUMBERS.get(detail[0], detail[0])).reshape(-1)
