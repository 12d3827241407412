# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The definitions in recordings are those of the message packages."""

import json
from pathlib import Path

import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from tap_ros.errors import RecordingError
from tap_ros.recording import schemas, topics

MSG_FOLDER = Path(__file__).parents[2] / 'tap_msgs' / 'msg'


def lines(text):
    """Return a definition line by line, without comments."""
    stripped = [' '.join(line.split('#')[0].split()) for line in text.splitlines()]
    return [line for line in stripped if line]


@pytest.mark.parametrize('path', sorted(MSG_FOLDER.glob('*.msg')), ids=lambda p: p.stem)
def test_equal_the_msg_files(path):
    assert lines(schemas.DEFINITIONS[f'tap_msgs/msg/{path.stem}']) == lines(path.read_text())


def test_no_msg_file_is_missing():
    ours = {name for name in schemas.DEFINITIONS if name.startswith('tap_msgs/')}
    assert ours == {f'tap_msgs/msg/{path.stem}' for path in MSG_FOLDER.glob('*.msg')}


@pytest.mark.parametrize('name', sorted(set(schemas.DEFINITIONS)))
def test_schema_text_is_understood_by_others(name):
    store = get_typestore(Stores.ROS2_JAZZY)
    found = get_types_from_msg(schemas.schema_text(name), name)
    standard = {key for key in found if key in store.types}
    if not name.startswith('tap_msgs/'):
        assert name in standard
    for key in standard:  # the same fields as in the type store of Jazzy
        assert found[key][1] == store.fielddefs[key][1]


def test_topics_of_a_recording_have_definitions_and_hashes():
    for name in topics.TYPES.values():
        assert schemas.schema_text(name)
        assert schemas.type_hash(name).startswith('RIHS01_')


def test_other_types_come_from_the_ros_installation(tmp_path, monkeypatch):
    folder = tmp_path / 'share' / 'my_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Wheel.msg').write_text(
        '# a wheel\nint32 MAX=3\nuint8[<=4] teeth\nHub hub  # in it\n')
    (folder / 'Hub.msg').write_text('string<=10 label "x"\ngeometry_msgs/Point[2] ends\n')
    (folder / 'Wheel.json').write_text(json.dumps(
        {'type_hashes': [{'type_name': 'my_msgs/msg/Wheel', 'hash_string': 'RIHS01_1'}]}))
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    assert schemas.fields('my_msgs/msg/Wheel') == (
        ('teeth', 'uint8', -1), ('hub', 'my_msgs/msg/Hub', None))
    text = schemas.schema_text('my_msgs/msg/Wheel')
    assert 'MSG: my_msgs/Hub\n' in text and 'MSG: geometry_msgs/Point\n' in text
    assert schemas.type_hash('my_msgs/msg/Wheel') == 'RIHS01_1'


def test_unknown_types_are_named(monkeypatch):
    monkeypatch.setenv('AMENT_PREFIX_PATH', '')
    with pytest.raises(RecordingError, match='message type no_msgs/msg/Thing: no definition'):
        schemas.schema_text('no_msgs/msg/Thing')


def test_a_schema_with_comments_is_accepted_and_another_is_not():
    name = 'tap_msgs/msg/ObjectStates'
    text = schemas.schema_text(name)
    schemas.check_schema(name, '# words\n' + text.replace('\n', '  # more words\n', 1))
    with pytest.raises(RecordingError, match='ObjectState: recorded .* name, u, pose;'):
        schemas.check_schema(name, text.replace('float64 v\n', ''))
