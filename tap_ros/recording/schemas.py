# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The message definitions of all that a recording of this package holds.

They stand here without comments so that recordings are written and read where neither ROS nor
tap_msgs is installed. Other types are looked up in the ROS installation, as rosbag2 does.
"""

from functools import cache
import json
import os
from pathlib import Path
import re

from tap_ros.errors import RecordingError

DEFINITIONS = {
    'builtin_interfaces/msg/Duration': 'int32 sec\nuint32 nanosec',
    'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec',
    'geometry_msgs/msg/Point': 'float64 x\nfloat64 y\nfloat64 z',
    'geometry_msgs/msg/Pose': 'Point position\nQuaternion orientation',
    'geometry_msgs/msg/Quaternion': 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1',
    'geometry_msgs/msg/Twist': 'Vector3 linear\nVector3 angular',
    'geometry_msgs/msg/TwistStamped': 'std_msgs/Header header\nTwist twist',
    'geometry_msgs/msg/Vector3': 'float64 x\nfloat64 y\nfloat64 z',
    'rosgraph_msgs/msg/Clock': 'builtin_interfaces/Time clock',
    'sensor_msgs/msg/CameraInfo': """
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
RegionOfInterest roi""",
    'sensor_msgs/msg/Image': """
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data""",
    'sensor_msgs/msg/JointState': """
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort""",
    'sensor_msgs/msg/RegionOfInterest': """
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify""",
    'std_msgs/msg/Float64': 'float64 data',
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id',
    'tap_msgs/msg/CommandRefused': 'std_msgs/Header header\nstring message',
    'tap_msgs/msg/Episode': """
uint8 START=0
uint8 END=1
std_msgs/Header header
uint8 event
string task
uint64 seed
string outcome""",
    'tap_msgs/msg/ObjectState': """
string name
float64 u
float64 v
geometry_msgs/Pose pose""",
    'tap_msgs/msg/ObjectStates': """
string SOURCE_GROUND_TRUTH="ground_truth"
string SOURCE_TRACKED="tracked"
std_msgs/Header header
string source
ObjectState[] objects""",
    'tap_msgs/msg/Subgoal': """
std_msgs/Header header
sensor_msgs/Image image
string[] object_names
sensor_msgs/Image[] object_maps
geometry_msgs/Point[] expected_pixels""",
}

# ROS 2's type hashes (REP 2011) of the types that are topics of a recording.
TYPE_HASHES = {
    'geometry_msgs/msg/TwistStamped':
        'RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64',
    'rosgraph_msgs/msg/Clock':
        'RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564',
    'sensor_msgs/msg/CameraInfo':
        'RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275',
    'sensor_msgs/msg/Image':
        'RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47',
    'sensor_msgs/msg/JointState':
        'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
    'std_msgs/msg/Float64':
        'RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a',
    'tap_msgs/msg/CommandRefused':
        'RIHS01_027bf0b0bf92e854e36759a30c80c55282b64dc397f65ba33c216aeddb7b22bb',
    'tap_msgs/msg/Episode':
        'RIHS01_4b355d513f5756a151f29200fa362d801ce3baa5ff3f074f01a00a6afc6c0d72',
    'tap_msgs/msg/ObjectStates':
        'RIHS01_a19a8b62077a10e37376bd21ebd34152acb541e8da1916db0c3f0763845f6555',
    'tap_msgs/msg/Subgoal':
        'RIHS01_69653ae223ad1e8fbe9232cea1cb772180d158f7cd844aad0c566b1b63754d64',
}

PRIMITIVES = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2',
    'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8', 'uint64': 'u8',
    'float32': 'f4', 'float64': 'f8'}

_FIELD = re.compile(
    r'(?P<type>[\w/]+)(?:<=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[a-z]\w*)')


@cache
def type_hash(type_name):
    """
    Return ROS 2's hash of a message type, or '' where it is not known.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    """
    if type_name in TYPE_HASHES:
        return TYPE_HASHES[type_name]
    path = _find_in_ros(type_name, '.json')
    if path is None:
        return ''
    hashes = json.loads(path.read_text())['type_hashes']
    return next((h['hash_string'] for h in hashes if h['type_name'] == type_name), '')


@cache
def schema_text(type_name):
    """
    Return the ros2msg schema of a message type: its definition and those of all types within.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    :raises RecordingError: when a definition is neither built in nor in the ROS installation.
    """
    parts, waiting, seen = [], [type_name], {type_name}
    while waiting:
        current = waiting.pop(0)
        text = definition(current)
        parts.append(text if current == type_name else f'MSG: {_short(current)}\n{text}')
        for _, base, _ in fields(current):
            if base not in PRIMITIVES and base != 'string' and base not in seen:
                seen.add(base)
                waiting.append(base)
    return ('\n' + '=' * 80 + '\n').join(parts) + '\n'


@cache
def definition(type_name):
    """
    Return the definition of one message type, the text of its .msg file.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    :raises RecordingError: when it is neither built in nor in the ROS installation.
    """
    if type_name in DEFINITIONS:
        return DEFINITIONS[type_name].strip()
    path = _find_in_ros(type_name, '.msg')
    if path is None:
        raise RecordingError(
            f'message type {type_name}: no definition found; built in are '
            f'{", ".join(sorted(DEFINITIONS))}. For others source the ROS 2 workspace that has it '
            '(AMENT_PREFIX_PATH)')
    return path.read_text().strip()


@cache
def fields(type_name):
    """
    Return the fields of a message type in their order.

    :param type_name: for example 'sensor_msgs/msg/Image'.
    :return: tuple of (name, type, count): type a key of PRIMITIVES, 'string' or a message type;
        count None for one value, -1 for a sequence, n for an array of n.
    :raises RecordingError: for a type without definition, or with wstring.
    """
    return _parse(type_name, definition(type_name))


def check_schema(type_name, text):
    """
    Accept the schema of a recording if its messages can be read with our definitions.

    :param type_name: for example 'tap_msgs/msg/Episode'.
    :param text: ros2msg, as schema_text gives it; with comments or without.
    :raises RecordingError: when fields differ; it names the type and both lists of fields.
    """
    name = type_name
    for part in re.split(r'^=+\n', text.replace('\r\n', '\n'), flags=re.MULTILINE):
        header = re.match(r'MSG: (\S+)\n', part)
        if header:
            name, part = _full(header[1], type_name), part[header.end():]
        if name in DEFINITIONS and _parse(name, part) != fields(name):
            theirs, ours = (
                ', '.join(field for field, _, _ in f) for f in (_parse(name, part), fields(name)))
            raise RecordingError(
                f'message type {name}: recorded with the fields {theirs}; expected {ours}')


def _parse(type_name, text):
    """Return the fields that stand in a definition, as fields does."""
    found = []
    for line in text.splitlines():
        match = _FIELD.match(line.split('#')[0].strip())
        if not match:  # a constant, a comment or an empty line
            continue
        base, array, name = match['type'], match['array'], match['name']
        if base == 'wstring':
            raise RecordingError(f'message type {type_name}: wstring fields cannot be read')
        if base not in PRIMITIVES and base != 'string':
            base = _full(base, type_name)
        count = None if array is None else int(array[1:-1]) if array[1:-1].isdigit() else -1
        found.append((name, base, count))
    return tuple(found)


def _find_in_ros(type_name, suffix):
    """Return the path of a definition in the ROS installation, or None."""
    package, _, name = type_name.split('/')
    for prefix in filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)):
        path = Path(prefix, 'share', package, 'msg', name + suffix)
        if path.is_file():
            return path
    return None


def _short(type_name):
    """Return 'sensor_msgs/Image' for 'sensor_msgs/msg/Image', as in schemas."""
    return type_name.replace('/msg/', '/')


def _full(name, within):
    """Return the full name of a type that is named in the definition of another."""
    package, _, base = name.rpartition('/')
    package = package.removesuffix('/msg') or within.split('/')[0]
    return f'{package}/msg/{base}'
