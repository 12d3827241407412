# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records of the BAIR data set, written here byte by byte, arrive as recordings."""

import struct

import cv2
import google_crc32c
import numpy as np
import pytest
from tap_ros.errors import RecordingError
from tap_ros.evaluation.prediction import evaluate
from tap_ros.prediction.batches import make_batch
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats.bair import find_shards, import_bair
from tap_ros.recording.formats.tfrecord import parse_example
from tap_ros.training.split import split_episodes


def masked(data):
    crc = google_crc32c.value(data)
    return struct.pack('<I', ((crc >> 15 | crc << 17 & 0xffffffff) + 0xa282ead8) % 2**32)


def frame_record(data):
    length = struct.pack('<Q', len(data))
    return length + masked(length) + data + masked(data)


def varint(value):
    result = b''
    while value > 127:
        result += bytes([value & 127 | 128])
        value >>= 7
    return result + bytes([value])


def field(number, data):
    return varint(number << 3 | 2) + varint(len(data)) + data


def feature(value):
    """Encode bytes as a BytesList, numbers as a packed FloatList."""
    if isinstance(value, bytes):
        return field(1, field(1, value))
    return field(2, field(1, struct.pack(f'<{len(value)}f', *value)))


def example(features):
    entries = (field(1, field(1, name.encode()) + field(2, feature(value)))
               for name, value in features.items())
    return field(1, b''.join(entries))


def make_features(seed, camera='image_aux1', frames=30, size=64):
    """Make up a record: {name: bytes or numbers}, and what it should become."""
    random = np.random.default_rng(seed)
    images = random.integers(0, 256, (frames, size, size, 3), np.uint8)
    positions = random.normal(size=(frames, 3)).astype(np.float32)
    actions = random.normal(size=(frames, 4)).astype(np.float32)
    features = {}
    for t in range(frames):
        features[f'{t}/action'] = actions[t].tolist()
        features[f'{t}/{camera}/encoded'] = images[t].tobytes()
        features[f'{t}/endeffector_pos'] = positions[t].tolist()
    return features, (images, positions, actions)


def write_file(folder, first, records, count=None):
    """Write a file of the data set from {name: value} of each record."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f'traj_{first}_to_{first + (count or len(records)) - 1}.tfrecords'
    path.write_bytes(b''.join(frame_record(example(record)) for record in records))
    return path


def refused(path, out):
    with pytest.raises(RecordingError) as error:
        import_bair([path], out, progress=False)
    return str(error.value)


@pytest.fixture
def made():
    return [make_features(seed) for seed in range(5)]


@pytest.fixture
def data_set(tmp_path, made):
    """Lay out five records as the data set does: 0 to 1 and 2 to 3 for training, 0 to test."""
    folder = tmp_path / 'softmotion30_44k'
    features = [record for record, _ in made]
    write_file(folder / 'train', 0, features[:2])
    write_file(folder / 'train', 2, features[2:4])
    write_file(folder / 'test', 0, features[4:])
    return folder


def assert_is(episode, expected):
    images, positions, actions = expected
    np.testing.assert_array_equal(episode.frames, images)
    np.testing.assert_array_equal(episode.grippers[:, :3], positions)
    assert np.isnan(episode.grippers[:, 3]).all()
    np.testing.assert_array_equal(episode.actions[:-1], actions[:-1])
    assert not episode.actions[-1].any()


def test_every_pixel_action_and_position_arrives(tmp_path, data_set, made):
    out = tmp_path / 'bair'
    assert import_bair([data_set], out, progress=False) == 5
    assert sorted(p.relative_to(out).as_posix() for p in out.rglob('*.mcap')) == [
        'test/test_0.mcap', 'train/train_0.mcap', 'train/train_2.mcap']
    train, test = open_recordings(out / 'train'), open_recordings(out / 'test')
    assert (len(train), len(test)) == (4, 1)
    for i, episode in enumerate([*(train[i] for i in range(4)), test[0]]):
        assert_is(episode, made[i][1])
        assert (episode.task, episode.object_names, episode.goal_frame) == ('bair', (), None)
        assert (np.diff(episode.stamps) > 0).all()


def test_train_and_test_do_not_share_seeds(tmp_path, data_set):
    import_bair([data_set], tmp_path / 'bair', progress=False)
    store = open_recordings(tmp_path / 'bair')
    seeds = [store[i].seed for i in range(len(store))]
    assert sorted(seeds) == [0, 1, 2, 3, 1_000_000]
    kept, held_out = split_episodes(store, 0.5)
    assert sorted([*kept, *held_out]) == list(range(5))


def test_a_record_is_the_same_in_any_order_of_keys_and_however_its_pictures_are_kept(tmp_path):
    features, expected = make_features(1)
    others = {name: value for camera in ('image_view0', 'image_main')
              for name, value in make_features(2, camera=camera)[0].items()}
    compressed = features | {
        f'{t}/image_aux1/encoded': cv2.imencode('.png', image[..., ::-1])[1].tobytes()
        for t, image in enumerate(expected[0])}
    records = [dict(sorted(features.items(), reverse=True)), {**others, **features}, compressed,
               make_features(1, camera='image_view0')[0]]
    import_bair([write_file(tmp_path, 0, records)], tmp_path / 'bair', progress=False)
    store = open_recordings(tmp_path / 'bair')
    assert len(store) == 4
    for i in range(4):
        assert_is(store[i], expected)


def test_numbers_that_are_not_packed_are_read_too():
    numbers = b''.join(b'\x0d' + struct.pack('<f', x) for x in (1.5, -2))
    entry = field(1, b'x') + field(2, field(2, numbers))
    np.testing.assert_array_equal(parse_example(field(1, field(1, entry)))['x'], [1.5, -2])


def test_a_damaged_record_is_named_and_what_came_before_stays(tmp_path, data_set, made):
    path, out = data_set / 'train' / 'traj_2_to_3.tfrecords', tmp_path / 'bair'
    whole = path.read_bytes()
    start = len(whole) // 2  # of the second record: both are equally long
    for where in (start, start + 9, start + 5000, len(whole) - 1):  # length, its CRC, data, CRC
        data = bytearray(whole)
        data[where] ^= 16
        path.write_bytes(data)
        assert 'traj_2_to_3.tfrecords: record 1 is damaged' in refused(data_set, out)
    for kept in (start + 3, start + 11, start + 12, start + 100_000, len(whole) - 5, -1):
        path.write_bytes(whole[:kept])
        assert f'{path}: record 1 is cut off' in refused(data_set, out)
    store = open_recordings(out)
    assert len(store) == 2
    assert_is(store[1], made[1][1])
    assert sorted(p.name for p in (out / 'train').iterdir()) == ['metadata.yaml', 'train_0.mcap']


def test_a_file_with_fewer_or_more_records_than_its_name_says_is_refused(tmp_path):
    features, _ = make_features(1)
    fewer = write_file(tmp_path / 'a', 0, [features], count=2)
    assert 'holds 2 records, but there are 1' in refused(fewer, tmp_path / 'bair')
    more = write_file(tmp_path / 'b', 0, [features, features], count=1)
    assert 'holds 1 records, but there are more' in refused(more, tmp_path / 'bair')
    assert not list((tmp_path / 'bair').rglob('*.mcap*'))


def test_a_record_that_lacks_something_is_named_with_what(tmp_path):
    good, _ = make_features(1)
    picture = '3/image_aux1/encoded'
    wide = cv2.imencode('.jpg', np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    for record, words in (
            *(({key: value for key, value in good.items() if key != name}, f'lacks {name}')
              for name in ('17/action', '0/endeffector_pos', '29/image_aux1/encoded',
                           '0/image_aux1/encoded')),
            (make_features(1, size=32)[0], '0/image_aux1/encoded has 3072 bytes'),
            (make_features(1, frames=29)[0], 'lacks 29/image_aux1/encoded'),
            (make_features(1, frames=31)[0], 'more than 30 frames'),
            (good | {picture: wide}, '64x48 pixels'),
            (good | {picture: b'\x89PNG not really'}, 'cannot be decoded'),
            (good | {picture: (1.0, 2.0)}, f'lacks {picture}'),
            (good | {'3/action': (1.0, 2.0, 3.0)}, 'lacks 3/action'),
            (good | {'3/action': b'abcd'}, 'lacks 3/action')):
        text = refused(write_file(tmp_path, 0, [record]), tmp_path / 'bair')
        assert 'record 0' in text and words in text
    (tmp_path / 'traj_0_to_0.tfrecords').write_bytes(frame_record(b'\x0a\xff'))
    assert 'record 0: holds no tf.train.Example' in refused(tmp_path, tmp_path / 'bair')


def test_an_import_goes_on_with_the_files_that_are_missing(tmp_path, data_set):
    out = tmp_path / 'bair'
    second = data_set / 'train' / 'traj_2_to_3.tfrecords'
    good = second.read_bytes()
    second.write_bytes(good[:-1])
    refused(data_set, out)
    second.write_bytes(good)
    before = (out / 'train' / 'train_0.mcap').stat()
    assert import_bair([data_set], out, progress=False) == 3
    after = (out / 'train' / 'train_0.mcap').stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert len(open_recordings(out)) == 5
    (out / 'train' / 'metadata.yaml').write_text('left behind')
    assert import_bair([data_set], out, progress=False) == 0
    assert len(open_recordings(out / 'train')) == 4


def test_what_does_not_belong_to_the_data_set_is_refused(tmp_path, data_set):
    out = tmp_path / 'bair'
    (tmp_path / 'empty').mkdir()
    assert 'holds no file' in refused(tmp_path / 'empty', out)
    assert 'traj_<first>_to_<last>' in refused(tmp_path / 'other.tfrecords', out)
    assert 'cannot be read' in refused(tmp_path / 'traj_0_to_1.tfrecords', out)
    (data_set / 'train' / 'traj_1_to_5.tfrecords').touch()
    assert 'hold the same trajectories' in refused(data_set, out)


def test_files_are_taken_in_the_order_of_their_numbers(tmp_path):
    for split, first in (('test', 0), ('test/train', 256), ('train', 1024), ('train/new', 0)):
        write_file(tmp_path / split, first, [], count=256)
    assert [(s.split, s.numbers.start) for s in find_shards([tmp_path])] == [
        ('train', 0), ('train', 256), ('train', 1024), ('test', 0)]


def test_prediction_is_evaluated_without_objects(tmp_path, data_set):
    import_bair([data_set], tmp_path / 'bair', progress=False)
    store = open_recordings(tmp_path / 'bair')
    batch = make_batch(store, range(5))
    assert batch.context.shape == (5, 2, 64, 64, 3)
    network = PredictorNetwork(PredictorConfig(image_size=64, base_width=4)).eval()
    for scores in evaluate(network, store, range(5)).values():
        assert np.isfinite(scores.min_l1).all() and np.isnan(scores.bottleneck).all()
        assert scores.summary()['bottleneck_episodes'] == 0
