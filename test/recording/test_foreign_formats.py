# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of other storages and messages are read as ours; for what is no bag a command is told."""

import bz2
from contextlib import closing
import gzip
from pathlib import Path
import shlex
import shutil
import sqlite3
import sys

import cv2
from made_bags import camera, joints, record, SECOND, write_mcap
import numpy as np
import pytest
from rosbags.rosbag2 import Writer as Ros2Writer
from tap_ros.__main__ import LINE, main
from tap_ros.apps.cli import read
from tap_ros.base.errors import RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.messages import typestore
from tap_ros.recording.reading import Reading
import zstandard

TOPIC = '/camera/image_raw'
SENT = [each for t in range(1, 6) for each in (camera(t), joints(t, gripper_x=t / 8))]


def write_sqlite3(folder):
    """Write a bag as ROS 2 Iron does, with a topic of a type that nobody installed."""
    with Ros2Writer(folder, version=8) as writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=typestore())
                  for topic, kind in dict.fromkeys((topic, kind) for topic, kind, *_ in SENT)}
        odd = writer.add_connection('/odd', 'odd_msgs/msg/Odd', msgdef='float64 x\n',
                                    rihs01='RIHS01_' + 64 * '0')
        for topic, _, data, log in SENT:
            writer.write(topics[topic], log, data)
            writer.write(odd, log, b'\0\1\0\0' + bytes(8))
    return folder


def write_bare_db3(folder):
    """Write a file without metadata and without definitions, as of Humble."""
    write_sqlite3(folder / 'whole')
    file = next((folder / 'whole').glob('*.db3')).rename(folder / 'bare.db3')
    with sqlite3.connect(file) as base:
        base.execute('DELETE FROM message_definitions')
    return file


def write_unmerged(folder):
    """Write a file whose recorder was killed: the second half stands beside it, in -wal."""
    whole, file = write_bare_db3(folder), folder / 'killed.db3'
    with closing(sqlite3.connect(whole)) as base:
        base.execute('PRAGMA journal_mode=WAL')
        rows = base.execute('SELECT * FROM messages ORDER BY id').fetchall()
        base.execute('DELETE FROM messages WHERE id > ?', (len(rows) // 2,))
        base.commit()
        base.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        base.executemany('INSERT INTO messages VALUES (?, ?, ?, ?)', rows[len(rows) // 2:])
        base.commit()
        for end in ('', '-wal'):
            shutil.copyfile(f'{whole}{end}', f'{file}{end}')
    whole.unlink()
    return file


def write_packed(folder):
    """Write a bag as of `ros2 bag record --compression-mode file`."""
    write_sqlite3(folder)
    file = next(folder.glob('*.db3'))
    Path(f'{file}.zstd').write_bytes(zstandard.compress(file.read_bytes()))
    file.unlink()
    return folder


@pytest.mark.parametrize('write, name', [
    (write_sqlite3, 'bag'), (write_bare_db3, ''), (write_unmerged, ''), (write_packed, 'bag')])
def test_bags_in_sqlite3_say_what_a_bag_of_ours_says(write, name, tmp_path):
    expected, = open_recordings(record(tmp_path / 'ours', SENT))
    (tmp_path / 'theirs').mkdir()
    path = write(tmp_path / 'theirs' / name)
    for place in (path, tmp_path / 'theirs'):
        for found in (list(open_recordings(place)), [open_recordings(place)[0]]):
            np.testing.assert_array_equal(found[0].frames, expected.frames)
            np.testing.assert_array_equal(found[0].stamps, expected.stamps)
            np.testing.assert_array_equal(found[0].grippers, expected.grippers)
            assert len(found) == 1


def test_what_is_beside_a_file_is_read_and_stays_as_it_is(tmp_path):
    file = write_unmerged(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.glob('killed*')}
    whole = open_recordings(file)
    assert {path: path.read_bytes() for path in before} == before
    file.with_name('killed.db3-wal').unlink()
    half = open_recordings(file)  # not what the cache keeps of the whole
    assert len(half[0]) < len(whole[0]) == 5


def test_mcap_beside_other_bags_is_refused_by_name(tmp_path):
    path = write_bare_db3(tmp_path)
    write_mcap(tmp_path / 'two.mcap', SENT)
    with pytest.raises(RecordingError, match='bare.db3'):
        open_recordings(tmp_path)
    assert len(open_recordings(path)) == len(open_recordings(tmp_path / 'two.mcap')) == 1


@pytest.mark.parametrize('name, content, command', [
    ('episode_0.hdf5', b'\x89HDF\r\n\x1a\n' + bytes(99), 'import-arrays'),
    ('robomimic/low.h5', b'\x89HDF\r\n\x1a\n' + bytes(99), 'import-arrays'),
    ('set/meta/info.json', b'{}', 'import-lerobot'),
    ('bridge/1.0.0/bridge-train.tfrecord-00000-of-00002', b'', 'import-tfrecord'),
    ('demo.mp4', b'\0\0\0\x18ftyp', 'import-video'),
    ('demos/7/front.MOV', b'\0\0\0\x18ftyp', 'import-video')])
def test_for_what_is_no_bag_the_command_is_told(name, content, command, tmp_path, capsys):
    file = tmp_path / 'in' / name
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    given = file.parents[1] if file.name == 'info.json' else file
    for path in {given, tmp_path / 'in' / name.split('/')[0]}:
        assert main(['inspect', str(path)]) == 1
        said = capsys.readouterr().err
        advice = shlex.split(said[said.index('python -m tap_ros'):])
        assert advice[3] == command and str(tmp_path) in advice[4] and read(LINE, advice[3:])


def test_messages_that_are_not_read_are_named_instead_of_a_topic_to_choose(tmp_path):
    for kind, encoding, words in (
            ('foxglove.RawImage', 'protobuf', 'encoded as protobuf; only those of ROS 2 are read'),
            ('foxglove_msgs/msg/CompressedVideo', 'cdr', 'holds packets of a video'),
            ('sensor_msgs/Image', 'ros1', 'encoded as ros1')):
        path = write_mcap(
            tmp_path / 'a.mcap', [(TOPIC, kind, b'x', SECOND)], schema=b'', encoding=encoding)
        with pytest.raises(RecordingError, match=words) as error:
            open_recordings(path)
        assert '--image-topic' not in str(error.value)


def test_what_is_no_bag_but_will_be_one_is_told_with_the_command(tmp_path, capsys):
    whole = write_mcap(tmp_path / 'whole.mcap', map(camera, (1, 2)))
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'bag_0.mcap.zst').write_bytes(zstandard.compress(whole.read_bytes()))
    assert [len(episode) for episode in open_recordings(tmp_path / 'bag')] == [2]
    for name, data, command in (
            ('a b.mcap.gz', gzip.compress(whole.read_bytes()), "gzip -dk '{}'"),
            ('a.tar.gz', gzip.compress(b''), 'tar -xf {}'),
            ('a.bag.bz2', bz2.compress(b'#ROSBAG'), 'bzip2 -dk {}'),
            ('a.zip', b'PK\3\4', 'unzip {}'), *(
                (name, b'version https://git-lfs.github.com/spec/v1\n', 'git lfs pull')
                for name in ('a.mcap', 'a.db3', 'a.hdf5'))):
        (tmp_path / name).write_bytes(data)
        assert main(['inspect', str(tmp_path / name)]) == 1
        assert f'type `{command.format(tmp_path / name)}`' in capsys.readouterr().err
    (tmp_path / 'a.bag').write_bytes(b'#ROSBAG V2.0\n')
    assert main(['inspect', str(tmp_path / 'a.bag')]) == 1
    assert f'rosbags-convert --src {tmp_path}/a.bag --dst ' in capsys.readouterr().err


def test_cameras_whose_arrays_end_alike_are_told_apart(tmp_path, capsys):
    h5py = pytest.importorskip('h5py')
    pictures = np.random.default_rng(0).integers(0, 256, (4, 8, 12, 3), np.uint8)
    files = [cv2.imencode('.jpg', picture)[1].tobytes() for picture in pictures]
    longest = max(map(len, files))
    with h5py.File(tmp_path / 'in.h5', 'w') as file:
        for i in range(2):
            for name, values in (('base_camera', np.array(files, f'S{longest}')),
                                 ('cam_2', np.array(files, f'V{longest}')), ('hand', None)):
                place = f'traj_{i}/obs/{name}'
                file[f'{place}/depth'] = np.ones((4, 8, 12, 1))
                if values is not None:
                    file[f'{place}/rgb'] = values
                    continue
                rows = file.create_dataset(f'{place}/rgb', 4, h5py.vlen_dtype(np.uint8))
                for row, data in enumerate(files):
                    rows[row] = np.frombuffer(data + bytes(40), np.uint8)
    words = ['import-arrays', str(tmp_path / 'in.h5'), '--out', str(tmp_path / 'bag')]
    assert main(words) == 1
    names = [f'obs/{name}/rgb' for name in ('base_camera', 'cam_2', 'hand')]
    assert f'--camera: expected one of {", ".join(names)}' in capsys.readouterr().err
    for number, name in enumerate(names):
        assert main([*words[:3], str(tmp_path / str(number)), '--camera', name]) == 0
        for episode in (found := list(open_recordings(tmp_path / str(number)))):
            assert abs(episode.frames.mean() - pictures.mean()) < 5
        assert [len(episode) for episode in found] == [4, 4]
    cameras = [word for name in names[1:] for word in ('--camera', name)]
    assert main([*words[:3], str(tmp_path / 'two'), '--rate', '5', *cameras]) == 0
    assert '/camera/obs_hand_rgb/image_raw: 4 pictures of obs/hand/rgb' in capsys.readouterr().out
    first, second = (list(open_recordings(tmp_path / 'two', reading=Reading(image_topic=topic)))
                     for topic in ('/camera/image_raw', '/camera/obs_hand_rgb/image_raw'))
    for one, other in zip(first, second, strict=True):
        assert len(one) == 2 and (one.frames == other.frames).all(), 'they show the same here'
        assert (one.stamps == other.stamps).all()


def test_arrays_of_pictures_are_imported_in_the_order_of_their_groups(
        tmp_path, capsys, monkeypatch):
    h5py = pytest.importorskip('h5py')
    pictures = np.random.default_rng(0).integers(0, 256, (13, 8, 12, 3), np.uint8)
    with h5py.File(tmp_path / 'in.hdf5', 'w') as file:
        for i in (10, 0, 2):
            demo = file.create_group(f'data/demo_{i}')
            demo['obs/front'] = np.moveaxis(pictures[i:i + 3], -1, 1) / np.float32(255)
            demo['obs/joints'], demo['next_obs/front'] = np.ones(3), pictures[i + 1:i + 4]
    words = ['import-arrays', str(tmp_path / 'in.hdf5'), '--fps', '5', '--out']
    assert main([*words, str(tmp_path / 'bag')]) == 0
    for episode, i in zip(open_recordings(tmp_path / 'bag'), (0, 2, 10), strict=True):
        np.testing.assert_array_equal(episode.frames, pictures[i:i + 3])
    monkeypatch.setitem(sys.modules, 'h5py', None)
    assert main([*words, str(tmp_path / 'c')]) == 1
    assert 'pip install h5py' in capsys.readouterr().err
