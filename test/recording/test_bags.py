# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a bag: found, written by a recorder that may be killed, described by metadata."""

import os
import signal
import subprocess
import sys

from made_bags import camera, gripper, IMAGE, read, record
from mcap.writer import Writer
import pytest
from tap_ros.errors import RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import RecordingWarning
from tap_ros.recording.messages import encode, schema_text
from tap_ros.recording.reader import iter_episodes
from tap_ros.recording.reading import Reading
from tap_ros.recording.writer import BagWriter


def test_what_is_no_recording_is_named(tmp_path):
    for data, words in ((b'', 'the file is empty'), (b'x', 'not an MCAP file'),
                        (b'SQLite format 3\0' * 9, 'not an MCAP file'),
                        (bytes(100), 'not an MCAP file')):
        (tmp_path / 'a.mcap').write_bytes(data)
        for path in (tmp_path, tmp_path / 'a.mcap'):
            with pytest.raises(RecordingError, match=f'a.mcap: {words}'):
                open_recordings(path)
    with pytest.raises(RecordingError, match='nowhere: there is no such file or folder'):
        open_recordings(tmp_path / 'nowhere')
    (tmp_path / 'folder').mkdir()
    with pytest.raises(RecordingError, match='holds no recording'):
        open_recordings(tmp_path / 'folder')


def test_no_image_topic_lists_the_topics_found(tmp_path):
    bag = record(tmp_path / 'bag', [gripper(1, 1)])
    for reading, words in (
            (Reading(), r'bag_0.mcap: .*/camera/image_raw.*found: /gripper/command \(std'),
            (Reading('/cam'), 'no topic /cam of type .*found: /gripper/command')):
        with pytest.raises(RecordingError, match=words):
            open_recordings(bag, reading=reading)


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


def test_bag_writer_splits_files(tmp_path):
    writer = BagWriter(tmp_path / 'bag', flush_seconds=-1.0, split_bytes=2000, compression='none')
    for t in range(40):
        writer.write_raw(*camera(t))
    writer.close()
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) > 3
    (episode,), _ = read(tmp_path / 'bag', reading=Reading(episode_seconds=0))
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
            ('push2_1.mcap', 'push2_7.mcap', 'not there: push2_7.mcap'),
            ('rosbag2_bagfile_information', 'nothing', 'not the metadata')):
        path.write_text(good.replace(old, new))
        with pytest.raises(RecordingError, match=f'metadata.yaml.*{words}'):
            open_recordings(bag)


UNUSABLE = [
    'relative_file_paths: null', 'relative_file_paths: [5]', 'relative_file_paths: {a: b}',
    'relative_file_paths: [push2_0.mcap, push2_0.mcap]', 'version: 2001-99-99',
    'relative_file_paths: [..]', f'relative_file_paths: [{"a" * 5000}]',
    'relative_file_paths: ["a\\0b\\e[2J\\n"]']


def test_unusable_metadata_is_one_line_that_names_it(bag):
    for text in UNUSABLE:
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
