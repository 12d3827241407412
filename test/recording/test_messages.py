# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages and their definitions are those of everybody."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from tap_ros.base.errors import RecordingError
from tap_ros.messages import topics
from tap_ros.recording.messages import (
    check_schema,
    decode,
    DEFINITIONS,
    encode,
    schema_text,
    type_hash,
    typestore,
)

MSG_FOLDER = Path(__file__).parents[2] / 'tap_msgs' / 'msg'
NAMES = sorted({*(topic.type for topic in topics.TOPICS), *DEFINITIONS})


def random_message(type_name, random):
    """Fill a message with random values; sequences get 0 to 3 elements."""
    def value(kind, detail):
        if kind == Nodetype.NAME:
            return random_message(detail, random)
        if kind == Nodetype.BASE:
            return ''.join(random.choice(list('abcd'), random.integers(0, 6))) \
                if detail[0] == 'string' else int(random.integers(0, 2))
        element, count = detail
        count = count if kind == Nodetype.ARRAY else random.integers(0, 4)
        return [value(*element) for _ in range(count)]
    return {name: value(*kind) for name, kind in typestore().fielddefs[type_name][1]}


def plain(value):
    """Return a message as random_message makes it."""
    if hasattr(value, '__dataclass_fields__'):
        return {name: plain(each) for name, each in vars(value).items()
                if name.islower() and name[0] != '_'}
    return [plain(each) for each in value] if isinstance(value, (list, np.ndarray)) else value


def test_round_trip():
    for name in NAMES:
        for seed in range(4):
            message = random_message(name, np.random.default_rng(seed))
            data = encode(name, message)
            assert encode(name, plain(decode(name, data))) == data
            assert plain(decode(name, data)) == message


def test_cut_off_messages_are_refused():
    name = 'tap_msgs/msg/ObjectStates'
    message = random_message(name, np.random.default_rng(1))
    data = encode(name, message)
    for length in range(len(data)):
        try:
            found = decode(name, data[:length])
        except RecordingError as error:
            assert 'damaged message' in str(error)
        else:  # only the states are cut off: a message of the earlier definition
            assert len(found.objects) == len(message['objects']) and not hasattr(found, 'states')


def test_bytes_that_a_serializer_leaves_behind_are_passed_over():
    name = 'sensor_msgs/msg/JointState'
    data = encode(name, {'name': ['a'], 'position': [1.5]})
    for count in (4, 8, 16):
        assert decode(name, data + count * b'x').position.tolist() == [1.5]
    with pytest.raises(RecordingError, match='damaged message'):
        decode(name, data + 40 * b'x')


def lines(text):
    """Return a definition line by line, without comments."""
    stripped = [' '.join(line.split('#')[0].split()) for line in text.splitlines()]
    return [line for line in stripped if line]


def test_our_definitions_are_the_msg_files():
    files = {f'tap_msgs/msg/{path.stem}': path.read_text() for path in MSG_FOLDER.glob('*.msg')}
    assert {name: lines(text) for name, text in DEFINITIONS.items()} == {
        name: lines(text) for name, text in files.items()}


@pytest.mark.ros
def test_type_hashes_are_those_of_the_ros_installation():
    expected = {}
    for prefix in os.environ['AMENT_PREFIX_PATH'].split(os.pathsep):
        for path in Path(prefix, 'share').glob('*/msg/*.json'):
            for entry in json.loads(path.read_text())['type_hashes']:
                expected[entry['type_name']] = entry['hash_string']
    assert {name: type_hash(name) for name in NAMES} == {name: expected[name] for name in NAMES}


def test_other_types_come_from_the_ros_installation(tmp_path, monkeypatch):
    folder = tmp_path / 'share' / 'my_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Wheel.msg').write_text(
        '# a wheel\nint32 MAX=3\nuint8[<=4] teeth\nHub hub  # in it\n')
    (folder / 'Hub.msg').write_text('string<=10 label "x"\ngeometry_msgs/Point[2] ends\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    text = schema_text('my_msgs/msg/Wheel')
    assert lines(text)[:3] == ['int32 MAX=3', 'uint8[<=4] teeth', 'my_msgs/Hub hub']
    assert 'MSG: my_msgs/Hub\n' in text and 'MSG: geometry_msgs/Point\n' in text
    assert type_hash('my_msgs/msg/Wheel').startswith('RIHS01_')


def test_a_schema_with_comments_is_accepted_and_another_is_not():
    name = 'tap_msgs/msg/ObjectStates'
    text = schema_text(name)
    check_schema(name, '# words\r\n' + text.replace('\n', '  # more words\r\n', 1))
    with pytest.raises(RecordingError, match='ObjectState: recorded .* name, u, pose;'):
        check_schema(name, text.replace('float64 v\n', ''))
    # A recorder that does not find a definition writes nothing, or half of it.
    for half in ('', 'Ärger\n', 'float64 x\n' * 10**6, '=' * 80,
                 text[:text.index('string source')]):
        check_schema(name, half)
