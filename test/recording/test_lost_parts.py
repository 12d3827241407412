# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is whole is read; what is not is named; nothing is silently missing, altered or joined."""

from functools import partial
import os
import random
import re
import struct
import warnings

from made_episodes import assert_all_equal, make_episode
from mcap.writer import CompressionType, Writer
import numpy as np
import pytest
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.evaluation import inspect_files
from tap_ros.recording import writer as writer_module
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.file_writer import FileWriter
from tap_ros.recording.messages import encode, schema_text
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.writer import BagWriter, EpisodeWriter
import zstandard

IMAGE = 'sensor_msgs/msg/Image'
SECOND = 10**9
CHUNK, MESSAGE_INDEX, DATA_END = 6, 7, 15


@pytest.fixture
def small_chunks(monkeypatch):
    """Make episodes span several chunks."""
    monkeypatch.setattr(writer_module, 'FileWriter', partial(FileWriter, chunk_bytes=3000))


@pytest.fixture
def chunked(tmp_path, small_chunks):
    """Write episodes into a file of many chunks."""
    episodes = [make_episode(i, T=4 + i % 3, start=(i + 1) * 10**10) for i in range(6)]
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        for episode in episodes:
            writer.write(episode)
    return tmp_path / 'a.mcap', episodes


def records(data):
    """Return the (opcode, start, end) of the records in the data section of a file."""
    position, found = 8, []
    while not found or found[-1][0] != DATA_END:
        kind, length = struct.unpack_from('<BQ', data, position)
        found.append((kind, position, position + 9 + length))
        position += 9 + length
    return found


def read(path):
    """Return (episodes, warnings) of a file read without a cache."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        found = list(iter_episodes(path))
    assert all(issubclass(w.category, RecordingWarning) for w in caught)
    texts = [str(w.message) for w in caught]
    assert not any('\n' in text or path.name not in text for text in texts)
    return found, texts


def check_part(found, episodes):
    """Check that an episode is an unaltered part of the one that was written."""
    whole = next(e for e in episodes if found.stamps[0] in e.stamps)
    start = whole.stamps.tolist().index(found.stamps[0])
    rows = slice(start, start + len(found))
    for field in ('stamps', 'frames'):
        np.testing.assert_array_equal(getattr(found, field), getattr(whole, field)[rows], field)
    for field in ('grippers', 'object_pixels', 'object_poses'):  # the last row may be cut off
        np.testing.assert_array_equal(
            getattr(found, field)[:-1], getattr(whole, field)[rows][:-1], field)
    np.testing.assert_array_equal(found.actions[:-1], whole.actions[rows][:-1])
    assert not found.actions[-1].any()
    assert (found.task, found.seed, found.object_names) == (
        whole.task, whole.seed, whole.object_names)
    assert found.outcome == 'interrupted' or (
        found.outcome == whole.outcome and found.stamps[-1] == whole.stamps[-1])
    if found.goal_frame is not None:
        np.testing.assert_array_equal(found.goal_frame, whole.goal_frame)


def check_damaged(path, episodes):
    """Check the law of damaged files; return 'same', 'part' or 'refused'."""
    try:
        found, texts = read(path)
    except RecordingError as error:
        assert path.name in str(error) and '\n' not in str(error)
        return 'refused'
    try:
        assert_all_equal(found, episodes)
    except AssertionError:
        for episode in found:
            check_part(episode, episodes)
        assert texts, 'episodes are missing or shorter, and nothing says so'
        return 'part'
    return 'same'


def test_flips_cuts_and_holes_are_named_or_harmless(chunked):
    path, episodes = chunked
    data, choose, seen = path.read_bytes(), random.Random(7), set()
    for trial in range(120):
        damaged, where = bytearray(data), choose.randrange(8, len(data))
        if trial % 4 == 0:
            damaged = damaged[:where]
        elif trial % 4 == 1:
            del damaged[where:where + choose.choice([1, 10, 1000])]
        else:
            damaged[where] ^= 1 << choose.randrange(8)
        path.write_bytes(damaged)
        seen.add(check_damaged(path, episodes))
    assert seen == {'same', 'part', 'refused'}


def test_flips_between_chunks_lose_nothing(chunked):
    path, episodes = chunked
    data = path.read_bytes()
    found = [r for r in records(data) if r[0] in (CHUNK, MESSAGE_INDEX, DATA_END)]
    for _, start, _ in random.Random(1).sample(found, 12):
        for byte, bit in ((0, 0), (0, 1), (0, 3), (0, 7), (1, 2), (4, 4)):  # opcode, length
            damaged = bytearray(data)
            damaged[start + byte] ^= 1 << bit
            path.write_bytes(damaged)
            assert_all_equal(read(path)[0], episodes)


def test_a_strange_record_between_chunks_loses_nothing(chunked):
    path, episodes = chunked
    data = path.read_bytes()
    _, start, _ = [record for record in records(data) if record[0] == CHUNK][3]
    path.write_bytes(data[:start] + struct.pack('<BQ', 0x33, 5) + bytes(5) + data[start:])
    found, texts = read(path)
    assert_all_equal(found, episodes)
    assert not texts


def test_without_a_summary_a_chunk_that_looks_like_another_record_is_named(chunked):
    path, episodes = chunked
    data = path.read_bytes()
    found = records(data)
    chunks = [start for kind, start, _ in found if kind == CHUNK]
    data = bytearray(data[:found[-1][1]])
    for bit in range(7):
        damaged, start = data.copy(), chunks[len(chunks) // 2]
        damaged[start] ^= 1 << bit
        path.write_bytes(damaged)
        assert check_damaged(path, episodes) == 'part'
        assert any(f'record at byte {start}, log time ' in text for text in read(path)[1])


@pytest.mark.parametrize('hole', ['cut out', 'zeros'])
def test_a_missing_chunk_is_named_with_its_place_and_its_messages(chunked, hole):
    path, episodes = chunked
    data = path.read_bytes()
    chunks = [(start, end) for kind, start, end in records(data) if kind == CHUNK]
    start, end = chunks[len(chunks) // 2]
    path.write_bytes(data[:start] + (bytes(end - start) if hole == 'zeros' else b'') + data[end:])
    assert check_damaged(path, episodes) == 'part'
    found, texts = read(path)
    assert len(found) >= 5
    assert any(f'chunk at byte {start}, log time ' in text for text in texts)
    assert any('messages are missing: ' in text and ' of topic /camera/image_raw' in text
               for text in texts)
    told = ' '.join(texts)
    gone, all_of_them = re.search(r'(\d+) of (\d+) of topic /camera/image_raw', told).groups()
    beside = re.search(r'(\d+) frames beside what is lost', told)
    assert sum(map(len, found)) + int(gone) + int(beside[1] if beside else 0) == int(all_of_them)
    with pytest.warns(RecordingWarning, match=f'chunk at byte {start}'):
        assert_all_equal(open_recordings(path), found)
    with pytest.warns(RecordingWarning, match=f'chunk at byte {start}'):  # from the cache
        assert_all_equal(open_recordings(path), found)


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


@pytest.mark.parametrize('bad', [*BAD, 'cut off'])
@pytest.mark.parametrize('at', [1, 4, 6])
def test_a_bad_picture_costs_itself_and_cuts_its_episode(tmp_path, bad, at):
    messages = [mark(1, 0), opening(2, 0.5)]
    for t in range(1, 7):
        good = image(t, t)
        if t == at:
            good = image(t, t, **BAD[bad]) if bad in BAD else (*good[:2], good[2][:40], good[3])
        messages.append(good)
    messages += [mark(6, 1, 'success'), mark(8, 0), image(8, 8), mark(8, 1, 'failure')]
    folder = record(tmp_path / 'bag', sorted(messages, key=lambda m: m[3]))
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
    cut.write_bytes(data[:records(data)[-1][1]])
    with pytest.warns(RecordingWarning, match='cut off'):
        first, second = iter_episodes(tmp_path)
    assert first.goal_frame[0, 0, 0] == 50
    assert second.frames[:, 0, 0, 0].tolist() == [3] and second.goal_frame is None


def test_goal_objects_that_cannot_be_used_take_back_those_before(tmp_path):
    kind = 'tap_msgs/msg/ObjectStates'
    data = encode(kind, {'header': {'stamp': {'sec': 1}}, 'objects': [{'name': 'a', 'u': 5}]})
    folder = record(tmp_path / 'bag', [
        mark(1, 0), ('/goal/objects', kind, data, SECOND), image(1, 1), mark(1, 1), mark(3, 0),
        ('/goal/objects', kind, data[:-9], 3 * SECOND), image(3, 3), mark(3, 1)])
    with pytest.warns(RecordingWarning, match='topic /goal/objects: 1 message cannot be used'):
        first, second = iter_episodes(folder)
    assert first.object_names == ('a',) and first.goal_pixels.tolist() == [[5, 0]]
    assert second.object_names == ()


@pytest.mark.parametrize('text', [
    'relative_file_paths: null', 'relative_file_paths: 5', 'relative_file_paths: [5]',
    'relative_file_paths: {a: b}', 'relative_file_paths: [[a]]',
    'relative_file_paths: [push2_0.mcap, push2_0.mcap]',
    'relative_file_paths: ' + '[' * 200000, 'relative_file_paths: ' + '{a: ' * 200000,
    'a: &a {b: c}\n  d: {<<: [*a, *a]}\n  relative_file_paths: [push2_0.mcap]',
    'version: 2001-99-99', 'version: ' + '1' * 5000, 'version: !!int ""', 'x: ' + 'y' * 2**23,
    'relative_file_paths: [../../etc/passwd]', 'relative_file_paths: [..]',
    f'relative_file_paths: [{"a" * 5000}]', 'relative_file_paths: ["a\\0b\\e[2J\\n"]'])
def test_unusable_metadata_is_one_line_that_names_it(bag, text):
    (bag / 'metadata.yaml').write_text(
        f'rosbag2_bagfile_information:\n  storage_identifier: mcap\n  {text}\n')
    with pytest.raises(RecordingError) as caught:
        open_recordings(bag)
    assert 'metadata.yaml' in str(caught.value)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 1000


def test_nothing_waits_for_a_fifo(tmp_path, bag):
    os.mkfifo(tmp_path / 'a.mcap')
    with pytest.raises(RecordingError, match='a.mcap: neither a regular file nor a folder'):
        open_recordings(tmp_path / 'a.mcap')
    (tmp_path / 'folder').mkdir()
    os.mkfifo(tmp_path / 'folder' / 'a.mcap')
    with pytest.raises(RecordingError, match='a.mcap: not a regular file'):
        open_recordings(tmp_path / 'folder')
    (bag / 'metadata.yaml').unlink()
    os.mkfifo(bag / 'metadata.yaml')
    with pytest.raises(RecordingError, match='metadata.yaml: not a regular file'):
        open_recordings(bag)


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


def test_tiny_messages_by_the_hundred_thousand_are_left_out(tmp_path):
    command = ('/gripper/command', 'std_msgs/msg/Float64', encode('std_msgs/msg/Float64', {}))
    path = tmp_path / 'a.mcap'
    bomb(path, [image(1, 1)[:3], *[command] * 300000])
    head = path.read_bytes()[:50000]  # without the indices, which make the file large
    start = head.index(b'zstd') - 41
    path.write_bytes(head[:start + 9 + struct.unpack_from('<Q', head, start + 1)[0]])
    assert path.stat().st_size < 50000
    with pytest.raises(RecordingError, match='a.mcap: chunk .* holds more than .* records'):
        open_recordings(tmp_path)


def test_chunks_that_unpack_to_gigabytes_in_all_are_left_out(tmp_path):
    path = tmp_path / 'a.mcap'
    bomb(path, [image(1, 1)[:3]])
    content = bytes([0x90]) + struct.pack('<Q', 2**27 - 9) + bytes(2**27 - 9)  # is skipped
    packed = zstandard.compress(content)
    record = struct.pack('<QQQII', 0, 0, len(content), 0, 4) + b'zstd' + struct.pack(
        '<Q', len(packed)) + packed
    with open(path, 'ab') as stream:
        stream.write((struct.pack('<BQ', CHUNK, len(record)) + record) * 3)
    with pytest.warns(RecordingWarning, match='chunk.* not unpacked: more than .* in all'):
        list(iter_episodes(path))


def test_states_that_would_take_minutes_to_decode_are_refused(tmp_path):
    kind = 'tap_msgs/msg/ObjectStates'
    data = encode(kind, {'objects': [{'name': 'a'}] * 1000})
    bomb(tmp_path / 'a.mcap', [image(1, 1)[:3], *[('/objects', kind, data)] * 400])
    assert (tmp_path / 'a.mcap').stat().st_size < 100000
    with pytest.raises(RecordingError, match='a.mcap: more than .* bytes of messages that are no'):
        open_recordings(tmp_path)


def test_a_huge_message_costs_itself(tmp_path):
    kind = 'tap_msgs/msg/ObjectStates'
    data = encode(kind, {'objects': [{'name': 'a'}] * 20000})
    folder = record(tmp_path / 'bag', [image(1, 1), ('/objects', kind, data, SECOND), image(2, 2)])
    with pytest.warns(RecordingWarning, match='topic /objects: 1 message .*more than 1048576'):
        (episode,) = iter_episodes(folder)
    assert len(episode) == 2


def test_one_message_with_many_objects_does_not_widen_all_others(tmp_path):
    kind = 'tap_msgs/msg/ObjectStates'
    few = ('/objects', kind, encode(kind, {'objects': [{'name': 'a'}]}))
    many = ('/objects', kind, encode(kind, {'objects': [{'name': 'a'}] * 4000}))
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
