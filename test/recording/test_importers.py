# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Videos and TFRecord files, whose records are written here byte by byte, arrive as recordings."""

import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
import time
import warnings

import cv2
import google_crc32c
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.reading import Reading


def masked(data):
    crc = google_crc32c.value(data)
    return struct.pack('<I', ((crc >> 15 | crc << 17 & 0xffffffff) + 0xa282ead8) % 2**32)


def varint(value):
    more = bytes([value & 127 | 128]) if value > 127 else b''
    return more + (varint(value >> 7) if value > 127 else bytes([value]))


def field(number, data):
    return varint(number << 3 | 2) + varint(len(data)) + data


def record(features):
    """Encode {name: list of bytes, or numbers} as a tf.train.Example in a TFRecord."""
    entries = b''
    for name, values in features.items():
        kind = field(1, b''.join(field(1, value) for value in values)) if isinstance(
            values[0], bytes) else field(2, field(1, struct.pack(f'<{len(values)}f', *values)))
        entries += field(1, field(1, name.encode()) + field(2, kind))
    data = field(1, entries)
    length = struct.pack('<Q', len(data))
    return length + masked(length) + data + masked(data)


def make_frames(seed, T=6, size=16):
    return np.random.default_rng(seed).integers(0, 256, (T, size, size, 3), np.uint8)


def png(picture):
    return cv2.imencode('.png', picture[..., ::-1])[1].tobytes()


def bair(frames):
    """Make the features of a BAIR record: raw pictures, each a feature of its own."""
    return {f'{t}/{name}': value for t, frame in enumerate(frames) for name, value in (
        ('image_aux1/encoded', [frame.tobytes()]), ('action', [0.0, 1.0, 2.0, 3.0]))}


def rlds(frames, **cameras):
    """Make the features of an RLDS episode."""
    return {**{f'steps/observation/{name}': [png(each) for each in pictures]
               for name, pictures in {'image_0': frames, **cameras}.items()},
            'steps/observation/state': [0.5] * 7 * len(frames),
            'steps/language_instruction': [b'put it there'] * len(frames)}


def run_import(capsys, *words):
    """Run a command; return its exit code and all that it printed."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter('always')
        code = main(list(map(str, words)))
    return code, ''.join((*capsys.readouterr(), *(str(each.message) for each in told)))


@pytest.mark.parametrize('make, task', [(bair, ''), (rlds, 'put it there')])
def test_records_of_both_kinds_come_in_the_order_of_their_files(make, task, tmp_path, capsys):
    for first in (2, 10):
        (tmp_path / f'traj_{first}_to_{first + 1}.tfrecords').write_bytes(
            b''.join(record(make(make_frames(first + i))) for i in range(2)))
    code, said = run_import(capsys, 'import-tfrecord', tmp_path, '--out', tmp_path / 'bag',
                            '--fps', 4)
    assert code == 0 and '4 episodes, 24 frames of 16x16 pixels of image_' in said
    found = open_recordings(tmp_path / 'bag')
    for number, (episode, seed) in enumerate(zip(found, (2, 3, 10, 11))):
        np.testing.assert_array_equal(episode.frames, make_frames(seed))
        assert (episode.task, episode.seed) == (task, number)
        assert set(np.diff(episode.stamps)) == {10**9 // 4}


def test_a_camera_is_asked_for_only_among_those_that_show_something(tmp_path, capsys):
    frames, wrist, blank = make_frames(0), make_frames(1), np.zeros_like(make_frames(0))
    file, out = tmp_path / 'a.tfrecord-00000-of-00001', tmp_path / 'bag'
    file.write_bytes(record(rlds(frames, image_1=blank)) + record(rlds(blank, image_1=blank)))
    code, said = run_import(capsys, 'import-tfrecord', file, '--out', out)
    assert code == 0 and ': 1 episode,' in said and 'left out: 1 episode whose' in said
    depth = rlds(frames, image_1=blank, wrist=wrist)
    depth['steps/observation/depth'] = 6 * [cv2.imencode('.png', np.full((8, 8), 900, np.uint16))[
        1].tobytes()]
    file.write_bytes(record(depth))
    code, said = run_import(capsys, 'import-tfrecord', file, '--out', tmp_path / 'b')
    assert code == 1 and 'expected one of image_0, wrist\n' in said
    assert run_import(capsys, 'import-tfrecord', file, '--out', tmp_path / 'b', '--camera',
                      'wrist', '--size', '8', '--crop', 'centre')[0] == 0
    assert open_recordings(tmp_path / 'b')[0].frames.shape == (6, 8, 8, 3)
    file.write_bytes(record(depth) + record(rlds(frames)))
    code, said = run_import(capsys, 'import-tfrecord', file, '--out', tmp_path / 'two',
                            '--camera', 'image_0', '--camera', 'wrist')
    assert code == 0 and '/camera/wrist/image_raw: 6 pictures of wrist' in said
    assert 'of wrist: --camera: wrist; expected one of image_0' in said, 'the second has none'
    seen = open_recordings(
        tmp_path / 'two', reading=Reading(image_topic='/camera/wrist/image_raw'))
    np.testing.assert_array_equal(seen[0].frames, wrist)
    np.testing.assert_array_equal(open_recordings(tmp_path / 'two')[0].frames, frames)


def test_damage_is_named_with_its_record_and_the_rest_is_read(tmp_path, capsys):
    file, good = tmp_path / 'a.tfrecord', record(rlds(make_frames(0)))
    spoiled = rlds(make_frames(0))
    spoiled['steps/observation/image_0'][3] = b'\x89PNG not really'
    wrong = good[:40] + b'x' + good[41:]
    for number, (data, words, lengths) in enumerate((
            (good + good[:-1], 'record 1 of a.tfrecord: it is cut off', [6]),
            (wrong + good, 'record 0 of a.tfrecord: it is damaged', [6]),
            (record(spoiled), 'picture 3 of record 0 of a.tfrecord: no picture', [5]),
            (wrong, 'its CRC does not match', []), (b'x' * 20, 'no uncompressed TFRecord', []),
            (record({'steps/reward': [1.0]}), 'there are none', []))):
        file.write_bytes(data)
        out = tmp_path / str(number)
        code, said = run_import(capsys, 'import-tfrecord', file, '--out', out)
        assert code == (not lengths) and words in said
        assert out.exists() == bool(lengths)
        assert not lengths or [len(e) for e in open_recordings(out)] == lengths


def write_video(path, frames, fps):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'mp4v'), fps,
                             frames.shape[2:0:-1])
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def test_each_video_is_a_demonstration_at_its_own_rate(tmp_path, capsys):
    levels = np.arange(0, 200, 20, np.uint8)
    frames = np.broadcast_to(levels[:, None, None, None], (10, 48, 64, 3))
    for name, fps in (('a', 10.0), ('b', 4.0)):
        write_video(tmp_path / f'{name}.mp4', frames, fps)
    code, said = run_import(
        capsys, 'import-video', tmp_path / 'a.mp4', tmp_path / 'b.mp4', '--out', tmp_path / 'bag',
        '--task', 'fold', '--crop', 'centre', '--size', 32)
    assert code == 0 and '2 episodes, 20 frames of 32x32 pixels' in said
    for episode, fps in zip(open_recordings(tmp_path / 'bag'), (10, 4)):
        assert np.abs(episode.frames.mean((1, 2, 3)) - levels).max() < 5
        np.testing.assert_allclose(np.diff(episode.stamps), 1e9 / fps, rtol=1e-3)
        assert episode.task == 'fold'
    (tmp_path / 'c.mp4').write_bytes(b'no video')
    code, said = run_import(capsys, 'import-video', tmp_path / 'c.mp4', '--out', tmp_path / 'c')
    assert code == 1 and 'c.mp4: is no video' in said
    code, said = run_import(capsys, 'import-video', tmp_path / 'a.mp4', '--out', tmp_path / 'bag')
    assert code == 1 and 'is not empty' in said


@pytest.mark.skipif('TAP_ROS_REAL' not in os.environ, reason='TAP_ROS_REAL names no folder')
@pytest.mark.parametrize('words', [
    ('import-video', 'droid_new_setup', '--camera', '0'),
    ('import-tfrecord', 'bridge-train.tfrecord', '--camera', 'image_0')])
def test_real_recordings_can_be_trained_on(words, tmp_path, capsys):
    """Videos of a DROID set-up (MIT) and clips of Bridge V2, in a folder that the user names."""
    command, name, *rest = words
    bag = tmp_path / 'bag'
    assert run_import(capsys, command, Path(os.environ['TAP_ROS_REAL'], name), *rest, '--out', bag,
                      '--crop', 'centre', '--size', 64)[0] == 0
    code, said = run_import(capsys, 'inspect', bag)
    assert code == 0 and 'episodes to learn from' in said


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_an_import_that_is_ended_leaves_nothing_in_the_way_of_the_next(tmp_path, number):
    set_, bag = tmp_path / 'set', tmp_path / 'bag'
    set_.mkdir()
    for k in range(30):
        write_video(set_ / f'{k:02}.avi', make_frames(k, 40, 256), 10)
    command = [sys.executable, '-m', 'tap_ros', 'import-video', str(set_), '--out', str(bag)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while not any(bag.glob('*.mcap*')) and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(number)
    assert process.wait(60) == (130 if number == signal.SIGINT else -number)
    assert bag.exists() == (number == signal.SIGKILL)
    assert subprocess.run(command, stderr=subprocess.DEVNULL).returncode == 0
    assert len(open_recordings([bag], progress=False)) == 30
    names = {path.name for path in bag.iterdir()}
    assert names == {'bag_0.mcap', 'bag_1.mcap', 'metadata.yaml'}
