# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is written is what is read, by us and by others."""

import dataclasses

from made_bags import read
from made_episodes import assert_all_equal, cover, make_episode
from mcap.reader import make_reader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from tap_ros.base.contract import CONTROL_PERIOD
from tap_ros.base.errors import RecordingError
from tap_ros.recording.writer import EpisodeWriter, write_metadata
import yaml


def write(path, episodes, **options):
    with EpisodeWriter(path, **options) as writer:
        for episode in episodes:
            writer.write(episode)
    return path


def test_round_trip(tmp_path, episodes):
    for compression in ('zstd', 'lz4', 'none'):
        path = write(tmp_path / f'{compression}.mcap', episodes, compression=compression)
        assert_all_equal(read(path)[0], episodes)


def test_round_trip_of_what_is_unusual(tmp_path):
    for changes in (
            {'goal_frame': None}, {'task': '', 'seed': 0, 'outcome': ''},
            {'outcome': 'interrupted'}, {'seed': 2**63 + 5},
            {'grippers': np.full((5, 4), np.nan, np.float32)},
            {'object_pixels': np.full((5, 2, 2), np.nan, np.float32)},
            {'goal_pixels': np.full((2, 2), np.nan, np.float32)}, {'stamps': np.arange(5)},
            {'stamps': np.array([0, 1, 10**9, 10**10, 10**12])}):
        unusual = dataclasses.replace(make_episode(1, start=10**11), **changes)
        episodes = [make_episode(0), unusual, make_episode(2, start=10**13)]
        assert_all_equal(read(write(tmp_path / 'a.mcap', episodes))[0], episodes)
    for lengths, objects, starts in (
            ([1] * 3, [2] * 3, [1, 2, 3]), ([5] * 3, [0] * 3, [1, 2, 3]),
            ([5] * 8, [0, 1, 2, 3] * 2, range(8)), ([3, 4, 5, 6], [2] * 4, [0] * 4)):
        episodes = [make_episode(i, T=T, K=K, start=start * 10**10)
                    for i, (T, K, start) in enumerate(zip(lengths, objects, starts, strict=True))]
        path = write(tmp_path / 'a.mcap', episodes)
        assert_all_equal(read(path)[0], episodes)
        with open(path, 'rb') as stream:
            times = [one.log_time for _, _, one in make_reader(stream).iter_messages(
                log_time_order=False)]
        assert times == sorted(times)


def test_others_read_the_bag(bag, episodes):
    frames, twists, ends = [], [], []
    with AnyReader([bag]) as reader:
        assert reader.message_count == sum(c.msgcount for c in reader.connections)
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == '/camera/image_raw':
                frames.append(message.data.reshape(message.height, message.width, 3))
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
            elif connection.topic == '/arm/delta_twist_cmds':
                linear = message.twist.linear
                twists.append((linear.x, linear.y, linear.z))
            elif connection.topic == '/episode' and message.event == message.END:
                ends.append((message.task, message.seed, message.outcome))
        qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    np.testing.assert_array_equal(frames, np.concatenate([e.frames for e in episodes]))
    np.testing.assert_array_equal(
        np.float32(CONTROL_PERIOD * np.array(twists)),
        np.concatenate([e.actions[:-1, :3] for e in episodes]))
    assert ends == [(e.task, e.seed, e.outcome) for e in episodes]
    assert qos['/goal/image'].durability.name == 'TRANSIENT_LOCAL'
    assert qos['/camera/image_raw'].durability.name == 'VOLATILE'
    for path in sorted(bag.glob('*.mcap')):
        with open(path, 'rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            assert reader.get_header().profile == 'ros2'
            messages = list(reader.iter_messages())
            assert len(messages) == reader.get_summary().statistics.message_count
    about = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert about['version'] == 9 and about['storage_identifier'] == 'mcap'
    assert about['relative_file_paths'] == ['push2_0.mcap', 'push2_1.mcap']
    assert about['message_count'] == sum(f['message_count'] for f in about['files']) == sum(
        t['message_count'] for t in about['topics_with_message_count'])


def test_files_play_in_the_order_of_their_numbers_or_of_the_metadata(tmp_path):
    for start in (1, 0):  # of all episodes, or of each
        folder = tmp_path / str(start)
        folder.mkdir()
        episodes = [make_episode(i, T=3, start=start * (i + 1) * 10**10) for i in range(11)]
        for number, episode in enumerate(episodes):
            write(folder / f'a_{number}.mcap', [episode])
        assert_all_equal(read(folder)[0], episodes)  # before there is a metadata.yaml
        write_metadata(folder)
        assert_all_equal(read(folder)[0], episodes)
    path = folder / 'metadata.yaml'
    text = path.read_text().replace('a_0.mcap', 'x').replace('a_10.mcap', 'a_0.mcap')
    path.write_text(text.replace('x', 'a_10.mcap'))
    assert_all_equal(read(folder)[0], [episodes[10], *episodes[1:10], episodes[0]])


def test_a_file_has_its_name_only_when_it_is_complete(tmp_path, episodes):
    with pytest.raises(KeyboardInterrupt), EpisodeWriter(tmp_path / 'a.mcap') as writer:
        writer.write(episodes[0])
        assert not (tmp_path / 'a.mcap').exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_unusable_episodes_are_refused_by_field(tmp_path):
    for field, value, words in (
            ('frames', np.zeros((5, 8, 12, 3), np.float32), 'uint8'),
            ('actions', np.zeros((4, 4), np.float32), r'expected shape \(5, 4\)'),
            ('actions', np.ones((5, 4), np.float32), 'zeros in the last row'),
            ('stamps', np.zeros(5, np.int64), 'increase'),
            ('robot_masks', np.ones((5, 8, 12), np.uint8), 'value 1'),
            ('goal_frame', None, 'expected None, as there is no goal_frame'),
            ('outcome', 'won', 'success')):
        episode = dataclasses.replace(cover(make_episode()), **{field: value})
        named = 'goal_mask' if value is None else field
        with pytest.raises(RecordingError, match=f'Episode.{named}: .*{words}'), \
                EpisodeWriter(tmp_path / 'a.mcap') as writer:
            writer.write(episode)
    with pytest.raises(RecordingError, match='zstd, lz4 or none'):
        EpisodeWriter(tmp_path / 'a.mcap', compression='gzip')
