# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages that cannot be used cost themselves and are named."""

import warnings

from made_episodes import assert_all_equal, make_episode
from mcap.writer import CompressionType, Writer
import numpy as np
import pytest
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.evaluation import inspect_files
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.messages import encode, schema_text
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.writer import BagWriter, EpisodeWriter

IMAGE = 'sensor_msgs/msg/Image'
OBJECTS = 'tap_msgs/msg/ObjectStates'
SECOND = 10**9


def image(second, value, **changes):
    """Return the message of a picture of 3x2 pixels."""
    fields = {'header': {'stamp': {'sec': second}}, 'height': 2, 'width': 3, 'encoding': 'rgb8',
              'step': 9, 'data': np.full(18, value, np.uint8)}
    return '/camera/image_raw', IMAGE, encode(IMAGE, fields | changes), second * SECOND


def mark(second, event, outcome=''):
    kind = 'tap_msgs/msg/Episode'
    return '/episode', kind, encode(kind, {
        'header': {'stamp': {'sec': second}}, 'event': event, 'task': 'push2', 'seed': 3,
        'outcome': outcome}), second * SECOND


def opening(second, value):
    return ('/gripper/command', 'std_msgs/msg/Float64',
            encode('std_msgs/msg/Float64', {'data': value}), second * SECOND)


def record(folder, messages):
    with BagWriter(folder) as writer:
        for message in messages:
            writer.write_raw(*message)
    return folder


BAD = {
    'another size': {'height': 4, 'width': 4, 'step': 12, 'data': bytes(48)},
    'as many bytes': {'height': 3, 'width': 2, 'step': 6},
    'rgb16': {'encoding': 'rgb16', 'step': 18, 'data': bytes(36)},
    'empty': {'height': 0, 'width': 0, 'step': 0, 'data': b''}, 'wrong step': {'step': 8}}


@pytest.mark.parametrize('at', [1, 4, 6])
def test_a_bad_picture_costs_itself_and_cuts_its_episode(tmp_path, at):
    for number, bad in enumerate([*BAD, 'cut off']):
        check_bad_picture(tmp_path / str(number), bad, at)


def check_bad_picture(path, bad, at):
    """Check what is read around a picture that is bad in one way."""
    messages = [mark(1, 0), opening(2, 0.5)]
    for t in range(1, 7):
        good = image(t, t)
        if t == at:
            good = image(t, t, **BAD[bad]) if bad in BAD else (*good[:2], good[2][:40], good[3])
        messages.append(good)
    messages += [mark(6, 1, 'success'), mark(8, 0), image(8, 8), mark(8, 1, 'failure')]
    folder = record(path / 'bag', sorted(messages, key=lambda m: m[3]))
    where = rf'bag_0.mcap: topic /camera/image_raw: 1 message .*log time {at}.000000000 s'
    with pytest.warns(RecordingWarning, match=where):
        found = list(iter_episodes(folder))
    with pytest.warns(RecordingWarning, match=where):
        assert_all_equal(open_recordings(folder), found)
    expected = {1: [[2, 3, 4, 5, 6]], 4: [[1, 2, 3], [5, 6]], 6: [[1, 2, 3, 4, 5]]}[at]
    outcomes = {1: ['success'], 4: ['interrupted', 'success'], 6: ['interrupted']}[at]
    assert [e.frames[:, 0, 0, 0].tolist() for e in found] == [*expected, [8]]
    assert [e.outcome for e in found] == [*outcomes, 'failure']
    assert {(e.task, e.seed) for e in found} == {('push2', 3)}
    if at == 4:  # the opening holds beyond the cut
        assert [e.actions[:, 3].tolist() for e in found[:2]] == [[0, 0.5, 0], [0.5, 0]]


def test_the_size_of_most_pictures_wins_though_the_first_is_another(tmp_path):
    folder = record(tmp_path / 'bag', [
        image(1, 1, **BAD['another size']), *(image(t, t) for t in range(2, 6))])
    for read_all in (lambda path: list(iter_episodes(path)), open_recordings):
        with pytest.warns(RecordingWarning, match='a picture of 4x4 pixels among those of 3x2'):
            (episode,) = read_all(folder)
        assert episode.frames[:, 0, 0, 0].tolist() == [2, 3, 4, 5]


def test_many_bad_pictures_are_one_warning(tmp_path):
    folder = record(tmp_path / 'bag', [
        image(t, t, **(BAD['rgb16'] if t % 2 else {})) for t in range(1, 100)])
    with pytest.warns(RecordingWarning) as caught:
        found = list(iter_episodes(folder))
    (text,) = (str(w.message) for w in caught)
    assert '50 messages cannot be used: encoding' in text and 'and 47 more' in text
    assert [len(e) for e in found] == [1] * 49


def test_a_goal_that_cannot_be_used_takes_back_the_one_before(tmp_path):
    def goal(second, value, **changes):
        return '/goal/image', *image(second, value, **changes)[1:]
    messages = [mark(1, 0), goal(1, 50), image(1, 1), mark(1, 1), mark(3, 0)]
    for changes in BAD.values():
        folder = record(tmp_path / str(len(changes) + len(str(changes))), [
            *messages, goal(3, 60, **changes), image(3, 3), mark(3, 1)])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always')
            first, second = iter_episodes(folder)
        assert first.goal_frame[0, 0, 0] == 50
        assert second.goal_frame is None
        assert caught or changes == BAD['empty']  # an empty one says that there is no goal


def test_a_goal_does_not_hold_beyond_a_file_that_is_cut_off(tmp_path):
    late = 2 * SECOND + 1  # the next nanosecond, in the next file
    goal = '/goal/image', *image(1, 50)[1:]
    for number, messages in enumerate((
            [mark(1, 0), goal, image(2, 2)],
            [(*image(3, 3)[:3], late), (*mark(3, 1, 'success')[:3], late)])):
        folder = record(tmp_path / str(number), messages)
        (folder / f'{number}_0.mcap').rename(tmp_path / f'bag_{number}.mcap')
    cut = tmp_path / 'bag_0.mcap'
    data = cut.read_bytes()
    cut.write_bytes(data[:data.rindex(b'\x0f\4' + bytes(7))])
    with pytest.warns(RecordingWarning, match='cut off'):
        first, second = iter_episodes(tmp_path)
    assert first.goal_frame[0, 0, 0] == 50
    assert second.frames[:, 0, 0, 0].tolist() == [3] and second.goal_frame is None


def test_goal_objects_that_cannot_be_used_take_back_those_before(tmp_path):
    data = encode(OBJECTS, {'header': {'stamp': {'sec': 1}}, 'objects': [{'name': 'a', 'u': 5}]})
    folder = record(tmp_path / 'bag', [
        mark(1, 0), ('/goal/objects', OBJECTS, data, SECOND), image(1, 1), mark(1, 1), mark(3, 0),
        ('/goal/objects', OBJECTS, data[:-9], 3 * SECOND), image(3, 3), mark(3, 1)])
    with pytest.warns(RecordingWarning, match='topic /goal/objects: 1 message cannot be used'):
        first, second = iter_episodes(folder)
    assert first.object_names == ('a',) and first.goal_pixels.tolist() == [[5, 0]]
    assert second.object_names == ()


def bomb(path, messages):
    """Write (topic, type, data) into one packed chunk without an index."""
    with open(path, 'wb') as stream:
        writer = Writer(stream, chunk_size=2**30, compression=CompressionType.ZSTD)
        writer.start('ros2')
        channels = {}
        for topic, kind, data in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, 'ros2msg', schema_text(kind).encode())
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], 0, data, 0)
        writer._Writer__finalize_chunk()


def test_states_that_would_take_minutes_to_decode_are_refused(tmp_path):
    data = encode(OBJECTS, {'objects': [{'name': 'a'}] * 1000})
    bomb(tmp_path / 'a.mcap', [image(1, 1)[:3], *[('/objects', OBJECTS, data)] * 400])
    assert (tmp_path / 'a.mcap').stat().st_size < 100000
    with pytest.raises(RecordingError, match='a.mcap: more than .* bytes of messages that are no'):
        open_recordings(tmp_path)


def test_a_huge_message_costs_itself(tmp_path):
    data = encode(OBJECTS, {'objects': [{'name': 'a'}] * 20000})
    folder = record(tmp_path / 'bag', [
        image(1, 1), ('/objects', OBJECTS, data, SECOND), image(2, 2)])
    with pytest.warns(RecordingWarning, match='topic /objects: 1 message .*more than 1048576'):
        (episode,) = iter_episodes(folder)
    assert len(episode) == 2


def test_one_message_with_many_objects_does_not_widen_all_others(tmp_path):
    few = ('/objects', OBJECTS, encode(OBJECTS, {'objects': [{'name': 'a'}]}))
    many = ('/objects', OBJECTS, encode(OBJECTS, {'objects': [{'name': 'a'}] * 4000}))
    bomb(tmp_path / 'a.mcap', [image(1, 1)[:3], *[few] * 5000, many])
    with pytest.raises(RecordingError, match='a.mcap: messages of up to 4000 objects'):
        open_recordings(tmp_path)


def test_inspect_shows_names_in_one_line(tmp_path, capsys):
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(make_episode(task='push2\n\x1b[2Jall is well'))
    args = inspect_files.Options(str(tmp_path / 'a.mcap'), episodes=1)
    with pytest.raises(ConfigError, match='12x8 pixels; the predictor needs square ones'):
        inspect_files.run(args)  # as train would refuse it
    lines = capsys.readouterr().out.splitlines()
    assert all(line.isprintable() for line in lines)
    assert r'task        push2\n\x1b[2Jall is well 1' in lines
