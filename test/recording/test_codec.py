# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Our CDR is everybody's CDR."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from tap_ros.errors import RecordingError
from tap_ros.recording.codec import decode, encode, Layout
from tap_ros.recording.schemas import DEFINITIONS, fields, PRIMITIVES, TYPE_HASHES

MSG_FOLDER = Path(__file__).parents[2] / 'tap_msgs' / 'msg'


@pytest.fixture(scope='module')
def store():
    """Give rosbags our messages too, from their .msg files."""
    store = get_typestore(Stores.ROS2_JAZZY)
    known = {}
    for path in sorted(MSG_FOLDER.glob('*.msg')):
        known |= get_types_from_msg(path.read_text(), f'tap_msgs/msg/{path.stem}')
    store.register(known)
    return store


def random_message(type_name, random):
    """Fill a message with random values; sequences get 0 to 3 elements."""
    message = {}
    for name, base, count in fields(type_name):
        n = int(random.integers(0, 4)) if count == -1 else count
        if base in PRIMITIVES:
            kind = np.dtype(PRIMITIVES[base])
            value = (random.normal(size=n) if kind.kind == 'f'
                     else random.integers(0, 2 if base == 'bool' else 100, n))
            message[name] = np.asarray(value, kind) if count is not None else kind.type(
                value).item()
        else:
            one = (lambda: ''.join(random.choice(list('abcd'), random.integers(0, 6)))) \
                if base == 'string' else (lambda base=base: random_message(base, random))
            message[name] = one() if count is None else [one() for _ in range(n)]
    return message


def as_rosbags(store, type_name, message):
    """Turn a nested dict into rosbags' message."""
    values = {}
    for name, base, count in fields(type_name):
        value = message[name]
        if base in DEFINITIONS:
            value = (as_rosbags(store, base, value) if count is None
                     else [as_rosbags(store, base, v) for v in value])
        values[name] = value
    return store.types[type_name](**values)


def assert_same(a, b):
    """Compare nested dicts."""
    if isinstance(b, dict):
        assert a.keys() == b.keys()
        for key in b:
            assert_same(a[key], b[key])
    elif isinstance(b, list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('type_name', sorted(DEFINITIONS))
@pytest.mark.parametrize('seed', range(4))
def test_equals_rosbags_and_round_trips(store, type_name, seed):
    message = random_message(type_name, np.random.default_rng(seed))
    data = encode(type_name, message)
    assert data == bytes(store.serialize_cdr(as_rosbags(store, type_name, message), type_name))
    assert_same(decode(type_name, data), message)


def test_reads_big_endian(store):
    message = random_message('sensor_msgs/msg/JointState', np.random.default_rng(5))
    data = store.serialize_cdr(
        as_rosbags(store, 'sensor_msgs/msg/JointState', message), 'sensor_msgs/msg/JointState',
        little_endian=False)
    assert_same(decode('sensor_msgs/msg/JointState', bytes(data)), message)


def test_left_out_fields_are_zero():
    kind = 'geometry_msgs/msg/TwistStamped'
    message = decode(kind, encode(kind, {}))
    assert message['twist']['linear'] == {'x': 0, 'y': 0, 'z': 0}
    assert message['header']['frame_id'] == ''


@pytest.mark.parametrize('type_name', sorted(DEFINITIONS))
def test_cut_off_messages_are_refused(type_name):
    message = random_message(type_name, np.random.default_rng(1))
    data = encode(type_name, message)
    for length in range(len(data)):
        with pytest.raises(RecordingError, match=type_name):
            decode(type_name, data[:length])


def test_huge_counts_are_refused():
    data = bytearray(encode('tap_msgs/msg/ObjectStates', {'objects': [{'name': 'a'}]}))
    where = data.rindex(b'\1\0\0\0', 0, data.index(b'a\0'))
    data[where:where + 4] = b'\xff\xff\xff\x7f'
    with pytest.raises(RecordingError, match='claims'):
        decode('tap_msgs/msg/ObjectStates', bytes(data))


def test_unknown_fields_and_wrong_lengths_are_named():
    with pytest.raises(RecordingError, match='no field nonsense; it has header, height'):
        encode('sensor_msgs/msg/Image', {'nonsense': 1})
    with pytest.raises(RecordingError, match='k: expected 9 values, got 4'):
        encode('sensor_msgs/msg/CameraInfo', {'k': np.zeros(4)})


def test_layout_reads_many_messages_at_once():
    kind = 'sensor_msgs/msg/JointState'
    messages = [encode(kind, {
        'header': {'stamp': {'sec': i, 'nanosec': 5}, 'frame_id': 'world'},
        'name': ['x', 'yy'], 'position': [i, -i]}) for i in range(6)]
    messages.append(encode(kind, {
        'header': {'frame_id': 'world'}, 'name': ['x', 'zz'], 'position': [1, 1]}))
    rows = np.array([list(m) for m in messages], np.uint8)
    layout = Layout(kind, messages[0])
    same = layout.matches(rows)
    assert same.tolist() == [True] * 6 + [False]  # another name is another layout
    assert layout.stamps(rows[same]).tolist() == [i * 10**9 + 5 for i in range(6)]
    assert layout.column(rows[same], 'position').tolist() == [[i, -i] for i in range(6)]


def test_type_hashes_are_those_of_ros(store):
    assert {name: store.hash_rihs01(name) for name in TYPE_HASHES} == TYPE_HASHES
