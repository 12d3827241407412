# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a bag: found, written by a recorder that may be killed, described by metadata."""

import os
import signal
import subprocess
import sys

from made_bags import camera, IMAGE, JOINTS, mark, read, record, shown, write_mcap
import pytest
from tap_ros.base.errors import RecordingError, RecordingWarning
from tap_ros.recording.bags import find_bags
from tap_ros.recording.cache import open_recordings
import yaml
import zstandard


def test_what_is_no_recording_is_named(tmp_path):
    for data, words in ((b'', 'the file is empty'), (b'x', 'not an MCAP file'),
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
    os.mkfifo(tmp_path / 'folder' / 'a.mcap')  # nothing waits for its writer
    with pytest.raises(RecordingError, match='a.mcap: not a regular file'):
        open_recordings(tmp_path / 'folder')


def test_a_recording_without_messages_says_so(tmp_path):
    empty = write_mcap(tmp_path / 'a.mcap', [])
    (tmp_path / 'cut.mcap').write_bytes(empty.read_bytes()[:40])  # of a recorder just killed
    (tmp_path / 'begun.mcap').write_bytes(empty.read_bytes()[:8])
    for path in tmp_path.glob('*.mcap'):
        with pytest.raises(RecordingError, match='holds no message'):
            open_recordings(path)
    only = write_mcap(tmp_path / 'b.mcap', [], [('/camera/image_raw', IMAGE)])
    with pytest.raises(RecordingError, match='b.mcap: holds no message'):
        open_recordings(only)


def test_a_bag_that_holds_others_says_that_they_are_left_out(tmp_path):
    for folder in ('', 'b2', 'b10'):
        (tmp_path / folder).mkdir(exist_ok=True)
        write_mcap(tmp_path / folder / 'a.mcap', [])
    with pytest.warns(RecordingWarning, match='those in b2, b10 in it are left out'):
        bag, = find_bags(tmp_path)
    assert list(bag.files) == [tmp_path / 'a.mcap']


KILLED = """
import sys, time
import numpy as np
from tap_ros.recording.messages import encode
from tap_ros.recording.file_writer import BagWriter
writer = BagWriter(sys.argv[1])
for t in range(10**6):
    stamp = {'sec': t + 1, 'nanosec': 0}
    writer.write_raw('/camera/image_raw', 'sensor_msgs/msg/Image', encode(
        'sensor_msgs/msg/Image', {'header': {'stamp': stamp}, 'height': 4, 'width': 4,
        'encoding': 'rgb8', 'step': 12, 'data': np.full(48, t % 256, np.uint8)}), (t + 1) * 10**9)
    writer.flush()
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
        (episode,) = open_recordings(tmp_path / 'bag')
    assert len(episode) >= written - 1
    assert shown([episode])[0] == [t % 256 for t in range(len(episode))]


def test_metadata_that_cannot_be_used_is_named_in_one_line(bag):
    path = bag / 'metadata.yaml'
    good = path.read_text()
    begin = 'rosbag2_bagfile_information:\n  storage_identifier: mcap\n  '
    for text, words in (
            (good.replace('push2_1.mcap', 'push2_7.mcap'), 'not there: push2_7.mcap'),
            (good.replace('rosbag2_bagfile_information', 'nothing'), 'not the metadata'),
            (begin + 'relative_file_paths: [[a]]', 'not the metadata'),
            (begin + 'relative_file_paths: [push2_0.mcap, push2_0.mcap]', 'a file twice'),
            (begin + 'version: ' + '[' * 100_000, 'levels deep'),
            (begin + f'relative_file_paths: [{"a" * 5000}]', 'not there'),
            (begin + 'relative_file_paths: [..]', 'not there'),
            (begin + 'relative_file_paths: ["a\\0b\\e[2J\\n"]', 'not'), ('', ''),
            ('!!python/object/apply:os.system [true]', 'not the metadata')):
        path.write_text(text)
        with pytest.raises(RecordingError, match=f'metadata.yaml.*{words}') as caught:
            open_recordings(bag)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 1000


def test_bags_that_rosbag2_compressed_are_read_with_metadata_and_without(tmp_path):
    messages = [mark(1, 0), *map(camera, range(1, 9)), mark(8, 1)]
    for number, (packed, described) in enumerate(
            (whole, described) for whole in (True, False) for described in (True, False)):
        bag = record(tmp_path / str(number), messages)
        file = bag / f'{number}_0.mcap'
        if packed:
            (bag / (file.name + '.zstd')).write_bytes(zstandard.compress(file.read_bytes()))
            file.unlink()
        else:
            write_mcap(file, [(topic, kind, zstandard.compress(data), log)
                              for topic, kind, data, log in messages])
        about = yaml.safe_load((bag / 'metadata.yaml').read_text())
        about['rosbag2_bagfile_information'] |= {
            'compression_format': 'zstd', 'compression_mode': 'FILE' if packed else 'MESSAGE',
            'relative_file_paths': [path.name for path in bag.glob('*.mcap*')]}
        (bag / 'metadata.yaml').write_text(yaml.safe_dump(about))
        if not described:
            (bag / 'metadata.yaml').unlink()
        for path in (bag, *bag.glob('*.mcap*')):
            assert shown(read(path)[0]) == [[*range(1, 9)]]


def test_definitions_that_say_nothing_are_those_of_everybody(tmp_path):
    messages = [*map(camera, range(1, 5))]
    for number, text in enumerate((b'', b'= = =\n', b'std_msgs/Header header\n')):
        bag = write_mcap(tmp_path / f'{number}.mcap', messages, schema=text)
        assert shown(read(bag)[0]) == [[1, 2, 3, 4]]
    bag = write_mcap(tmp_path / 'a.mcap', messages, schema=b'uint32 height\nuint32 size\n')
    with pytest.raises(RecordingError, match='a.mcap: topic /camera/image_raw: .*height, size;'):
        open_recordings(bag)
    write_mcap(tmp_path / 'b.mcap', messages, [('/joint_states', JOINTS)])
    assert shown(read(tmp_path / 'b.mcap')[0]) == [[1, 2, 3, 4]]
