# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What was recorded before the damage stays readable; what cannot be read is named."""

import signal
import struct
import subprocess
import sys

from made_episodes import assert_all_equal, make_episode
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
import pytest
from tap_ros.errors import RecordingError
from tap_ros.recording import mcap_file
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.file_writer import FileWriter
from tap_ros.recording.messages import encode, schema_text
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import BagWriter, EpisodeWriter
import zstandard

IMAGE = 'sensor_msgs/msg/Image'


@pytest.fixture
def long_file(tmp_path):
    """Write a file of several chunks."""
    episodes = [make_episode(i, T=9, size=(64, 64), start=(i + 1) * 10**10) for i in range(20)]
    with EpisodeWriter(tmp_path / 'long.mcap') as writer:
        for episode in episodes:
            writer.write(episode)
    return tmp_path / 'long.mcap', episodes


def count_with_mcap(path):
    """Return how many frames mcap's own reader finds before it gives up."""
    frames = 0
    with open(path, 'rb') as stream:
        try:
            for _, channel, _ in NonSeekingReader(stream).iter_messages(log_time_order=False):
                frames += channel.topic == '/camera/image_raw'
        except (McapError, struct.error):
            pass
    return frames


@pytest.mark.parametrize('share', [0.3, 0.6, 0.9, 0.995])
def test_complete_chunks_of_a_cut_off_file_are_read(long_file, share):
    path, episodes = long_file
    path.write_bytes(path.read_bytes()[:int(path.stat().st_size * share)])
    with pytest.warns(RecordingWarning, match='long.mcap: the file is cut off at byte'):
        found = list(iter_episodes(path))
    assert 0 < len(found) < len(episodes) or share > 0.99
    assert sum(len(e) for e in found) == count_with_mcap(path)
    assert_all_equal(found[:-1], episodes[:len(found) - 1])
    last = episodes[len(found) - 1]
    if len(found[-1]) < len(last):
        assert found[-1].outcome == 'interrupted'
        np.testing.assert_array_equal(found[-1].frames, last.frames[:len(found[-1])])
        np.testing.assert_array_equal(found[-1].actions[:-1], last.actions[:len(found[-1]) - 1])
    with pytest.warns(RecordingWarning, match='long.mcap'):
        assert_all_equal(open_recordings(path), found)
    with pytest.warns(RecordingWarning, match='long.mcap'):  # and again from the cache
        assert_all_equal(open_recordings(path), found)


@pytest.mark.filterwarnings('ignore::tap_ros.recording.episode.RecordingWarning')
def test_a_cut_anywhere_gives_what_is_there_or_a_clear_error(tmp_path):
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(make_episode())
    data = (tmp_path / 'a.mcap').read_bytes()
    whole = 0
    for length in range(0, len(data), 397):
        (tmp_path / 'b.mcap').write_bytes(data[:length])
        try:
            assert_all_equal(iter_episodes(tmp_path / 'b.mcap'), [make_episode()])
            whole += 1
        except RecordingError as error:
            assert 'b.mcap' in str(error)
            assert whole == 0
    assert whole > 3


def test_zeros_that_a_crash_left_behind_end_the_file(long_file):
    path, episodes = long_file
    data = path.read_bytes()
    position = 8
    while position < len(data) // 2:
        position += 9 + struct.unpack_from('<BQ', data, position)[1]
    path.write_bytes(data[:position] + bytes(10**6))
    with pytest.warns(RecordingWarning, match=f'cut off at byte {position}'):
        found = list(iter_episodes(path))
    assert_all_equal(found[:-1], episodes[:len(found) - 1])
    assert len(found) > 5


def test_a_flipped_bit_costs_its_chunk(long_file):
    path, episodes = long_file
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.warns(RecordingWarning, match='long.mcap: chunk at byte .*its checksum'):
        found = list(iter_episodes(path))
    assert_all_equal(found[:4], episodes[:4])
    assert_all_equal(found[-4:], episodes[-4:])


def test_empty_file(tmp_path):
    (tmp_path / 'a.mcap').write_bytes(b'')
    with pytest.raises(RecordingError, match='a.mcap: the file is empty'):
        open_recordings(tmp_path)


@pytest.mark.parametrize('data', [b'x', b'SQLite format 3\0' * 9, bytes(100)])
def test_not_mcap(tmp_path, data):
    (tmp_path / 'a.mcap').write_bytes(data)
    with pytest.raises(RecordingError, match='a.mcap: not an MCAP file'):
        open_recordings(tmp_path / 'a.mcap')


def test_nothing_there(tmp_path):
    with pytest.raises(RecordingError, match='nowhere: there is no such file or folder'):
        open_recordings(tmp_path / 'nowhere')
    with pytest.raises(RecordingError, match='holds no recording'):
        open_recordings(tmp_path)


def test_no_image_topic_lists_the_topics_found(tmp_path):
    file = FileWriter(tmp_path / 'a.mcap')
    file.write_raw('/speed', 'std_msgs/msg/Float64', encode('std_msgs/msg/Float64', {}), 1)
    file.close()
    with pytest.raises(RecordingError, match=r'a.mcap: .*/camera/image_raw.*found: /speed \(std'):
        open_recordings(tmp_path)
    with pytest.raises(RecordingError, match='no topic /cam of type .*found: /speed'):
        list(iter_episodes(tmp_path, Reading('/cam')))


def test_image_topic_without_any_image(tmp_path):
    stream = open(tmp_path / 'a.mcap', 'wb')
    writer = Writer(stream)
    writer.start('ros2')
    schema = writer.register_schema(IMAGE, 'ros2msg', schema_text(IMAGE).encode())
    writer.register_channel('/camera/image_raw', 'cdr', schema)
    writer.finish()
    stream.close()
    with pytest.raises(RecordingError, match='a.mcap: the image topic holds no image'):
        open_recordings(tmp_path)


def chunk_bomb(path, claimed, content):
    """Write a file with one zstd chunk that unpacks to more, or claims to."""
    packed = zstandard.compress(content)
    head = struct.pack('<QQQII', 0, 0, claimed, 0, 4) + b'zstd' + struct.pack('<Q', len(packed))
    record = head + packed
    path.write_bytes(b'\x89MCAP0\r\n' + struct.pack('<BQ', 6, len(record)) + record)


def test_chunks_that_claim_too_much_are_not_unpacked(tmp_path):
    chunk_bomb(tmp_path / 'a.mcap', mcap_file.MAX_CHUNK_BYTES + 1, bytes(100))
    with pytest.raises(RecordingError, match='a.mcap: chunk .* claims to unpack to'):
        open_recordings(tmp_path)


def test_chunks_that_hold_more_than_they_claim_are_not_unpacked(tmp_path):
    chunk_bomb(tmp_path / 'a.mcap', 1000, bytes(50 * 2**20))
    with pytest.raises(RecordingError, match='a.mcap: chunk .* more than it claims'):
        open_recordings(tmp_path)


def test_a_wrong_index_does_no_harm(long_file):
    path, episodes = long_file
    data = bytearray(path.read_bytes())
    position, changed = 8, 0
    while data[position] != 15:
        kind, length = struct.unpack_from('<BQ', data, position)
        if kind == 7:
            data[position + 9 + 14] ^= 0x5a  # the offset of the first entry
            changed += 1
        position += 9 + length
    assert changed > 5
    path.write_bytes(data)
    assert_all_equal(iter_episodes(path), episodes)


def rewrite(path, other, **options):
    """Copy the messages of a file as another writer would write them."""
    with open(other, 'wb') as out, open(path, 'rb') as stream:
        writer, ids = Writer(out, **options), {}
        writer.start('ros2')
        for schema, channel, message in NonSeekingReader(stream).iter_messages(
                log_time_order=False):
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, 'cdr', number)
            writer.add_message(
                ids[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()


@pytest.mark.parametrize('options', [
    {'use_chunking': False}, {'index_types': IndexType.NONE},
    {'compression': CompressionType.NONE, 'enable_crcs': False}, {'repeat_schemas': False},
    {'repeat_channels': False, 'repeat_schemas': False, 'use_statistics': False}],
    ids=lambda options: ','.join(options))
def test_other_ways_to_write_mcap(tmp_path, long_file, options):
    path, episodes = long_file
    rewrite(path, tmp_path / 'other.mcap', **options)
    assert_all_equal(iter_episodes(tmp_path / 'other.mcap'), episodes)


@pytest.mark.parametrize('kind, length, words', [
    (5, 21, 'too short'), (5, 2**40, 'wrong length'), (0x33, None, 'opcode 51')])
def test_damage_that_no_checksum_shows_costs_its_chunk(tmp_path, long_file, kind, length, words):
    path, episodes = long_file
    other = tmp_path / 'other.mcap'
    rewrite(
        path, other, chunk_size=2**18, compression=CompressionType.NONE, enable_crcs=False)
    data = bytearray(other.read_bytes())
    where = data.index(episodes[10].frames[4].tobytes())
    start = data.rindex(b'camera_optical_frame\0', 0, where) - 47  # 31 + 16 bytes
    assert data[start] == 5
    data[start] = kind
    if length is not None:
        data[start + 1:start + 9] = struct.pack('<Q', length)
    other.write_bytes(data)
    with pytest.warns(RecordingWarning, match=f'chunk at byte .*it holds a damaged .*{words}'):
        found = list(iter_episodes(other))
    assert_all_equal(found[:5], episodes[:5])
    assert_all_equal(found[-5:], episodes[-5:])


def test_messages_that_nothing_describes_are_named(tmp_path):
    with open(tmp_path / 'a.mcap', 'wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        schema = writer.register_schema(IMAGE, 'ros2msg', schema_text(IMAGE).encode())
        number = writer.register_channel('/camera/image_raw', 'cdr', schema)
        for t in range(1, 6):
            data = encode(IMAGE, {
                'header': {'stamp': {'sec': t}}, 'height': 1, 'width': 1, 'encoding': 'mono8',
                'step': 1, 'data': b'\7'})
            writer.add_message(99 if t == 3 else number, t * 10**9, data, t * 10**9)
        writer.finish()
    with pytest.warns(RecordingWarning, match='log time 3.000000000 s: messages of channel 99,'):
        found = list(iter_episodes(tmp_path))
    assert [len(episode) for episode in found] == [2, 2]


KILLED = """
import sys, time
import numpy as np
from tap_ros.recording.messages import encode
from tap_ros.recording.writer import BagWriter
writer = BagWriter(sys.argv[1], flush_seconds=0.0)
for t in range(10**6):
    stamp = {'sec': t + 1, 'nanosec': 0}
    writer.write_raw('/camera/image_raw', 'sensor_msgs/msg/Image', encode(
        'sensor_msgs/msg/Image', {'header': {'stamp': stamp}, 'height': 4, 'width': 4,
        'encoding': 'rgb8', 'step': 12, 'data': np.full(48, t % 256, np.uint8)}), (t + 1) * 10**9)
    print(t, flush=True)
    time.sleep(0.002)
"""


def test_a_killed_recorder_leaves_a_readable_bag(tmp_path):
    run = subprocess.Popen(
        [sys.executable, '-c', KILLED, str(tmp_path / 'bag')], stdout=subprocess.PIPE, text=True)
    for _ in range(20):
        written = int(run.stdout.readline())
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    with pytest.warns(RecordingWarning, match='bag_0.mcap'):
        (episode,) = iter_episodes(tmp_path / 'bag')
    assert len(episode) >= written - 1
    assert episode.frames[:, 0, 0, 0].tolist() == [t % 256 for t in range(len(episode))]


def test_a_bag_in_progress_is_readable_after_a_flush(tmp_path):
    writer = BagWriter(tmp_path / 'bag', flush_seconds=1e9)
    for t in range(3):
        writer.write_raw('/camera/image_raw', IMAGE, encode(IMAGE, {
            'header': {'stamp': {'sec': t}}, 'height': 1, 'width': 1, 'encoding': 'mono8',
            'step': 1, 'data': b'\7'}), t * 10**9)
    writer.flush()
    with pytest.warns(RecordingWarning):
        (episode,) = iter_episodes(tmp_path / 'bag')
    assert episode.frames.tolist() == [[[[7, 7, 7]]]] * 3
    writer.close()
    (episode,) = iter_episodes(tmp_path / 'bag')
    assert len(episode) == 3


def test_bag_writer_splits_files(tmp_path, monkeypatch):
    writer = BagWriter(tmp_path / 'bag', flush_seconds=-1.0, split_bytes=4000, compression='none')
    for t in range(40):
        writer.write_raw('/camera/image_raw', IMAGE, encode(IMAGE, {
            'header': {'stamp': {'sec': t + 1}}, 'height': 10, 'width': 10, 'encoding': 'rgb8',
            'step': 30, 'data': bytes([t] * 300)}), (t + 1) * 10**9)
    writer.close()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) > 3
    whole = Reading(episode_seconds=0)
    (episode,) = iter_episodes(tmp_path / 'bag', whole)  # one episode in many files
    assert episode.frames[:, 0, 0, 0].tolist() == list(range(40))
    (episode,) = open_recordings(tmp_path / 'bag', reading=whole)
    assert episode.frames[:, 0, 0, 0].tolist() == list(range(40))


def test_bag_writer_keeps_what_is_there(tmp_path):
    (tmp_path / 'precious').write_text('')
    with pytest.raises(RecordingError, match='is not empty'):
        BagWriter(tmp_path)


def test_bag_writer_refuses_unknown_and_changed_types(tmp_path, monkeypatch):
    monkeypatch.setenv('AMENT_PREFIX_PATH', '')
    with BagWriter(tmp_path / 'bag') as writer:
        with pytest.raises(RecordingError, match='my_msgs/msg/Thing: no definition'):
            writer.write_raw('/a', 'my_msgs/msg/Thing', b'', 0)
        writer.write_raw('/a', 'std_msgs/msg/Float64', encode('std_msgs/msg/Float64', {}), 0)
        with pytest.raises(RecordingError, match='/a has the type std_msgs/msg/Float64'):
            writer.write_raw('/a', IMAGE, b'', 1)


def test_metadata_that_cannot_be_used_is_named(bag):
    path = bag / 'metadata.yaml'
    good = path.read_text()
    for old, new, words in (
            ('storage_identifier: mcap', 'storage_identifier: sqlite3', 'only mcap is read'),
            ("compression_format: ''", 'compression_format: zstd', 'compressed by rosbag2'),
            ('push2_1.mcap', 'push2_7.mcap', 'not there: push2_7.mcap'),
            ('rosbag2_bagfile_information', 'nothing', 'not the metadata')):
        path.write_text(good.replace(old, new))
        with pytest.raises(RecordingError, match=f'metadata.yaml.*{words}'):
            open_recordings(bag)
    path.write_text('a: [')
    with pytest.raises(RecordingError, match='metadata.yaml'):
        open_recordings(bag)
