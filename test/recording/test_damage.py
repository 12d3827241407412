# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged files: what is whole is read, what is not is named, nothing is altered or joined."""

import random
import re
import struct
import warnings

from made_episodes import assert_all_equal, make_episode
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
import pytest
from tap_ros.base.errors import RecordingError, RecordingWarning
from tap_ros.recording import file_writer, mcap_file
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.writer import EpisodeWriter
import zstandard

IMAGE = 'sensor_msgs/msg/Image'
CHUNK, MESSAGE_INDEX, DATA_END = 6, 7, 15


@pytest.fixture
def chunked(tmp_path, monkeypatch):
    """Write episodes into a file of many chunks, most of which span several."""
    monkeypatch.setattr(file_writer, 'CHUNK_BYTES', 3000)
    episodes = [make_episode(i, T=4 + i % 3, start=(i + 1) * 10**10) for i in range(9)]
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
        found = list(open_recordings(path))
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
    whole, choose, seen = path.read_bytes(), random.Random(7), set()
    for trial in range(80):
        data = whole[:records(whole)[-1][1]] if trial % 5 == 0 else whole  # without a summary
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


def test_complete_chunks_of_a_cut_off_file_are_read(chunked):
    path, episodes = chunked
    data = path.read_bytes()
    boundary = [start for _, start, _ in records(data) if start > 0.5 * len(data)][0]
    for length, zeros in ((0.3 * len(data), 0), (0.6 * len(data), 0),
                          (boundary, 10**6)):  # zeros are what a crash of the machine leaves
        path.write_bytes(data[:int(length)] + bytes(zeros))
        with pytest.warns(RecordingWarning, match='a.mcap: the file is cut off at byte'):
            found = list(open_recordings(path))
        frames = sum(map(len, found))
        assert frames > 0.25 * sum(map(len, episodes))
        for episode in found:
            check_part(episode, episodes)
        with pytest.warns(RecordingWarning, match='a.mcap: the file is cut off'):  # of the cache
            assert_all_equal(open_recordings(path), found)


def test_flips_between_chunks_lose_nothing(chunked):
    path, episodes = chunked
    data = path.read_bytes()
    found = [r for r in records(data) if r[0] in (CHUNK, MESSAGE_INDEX, DATA_END)]
    for _, start, _ in random.Random(1).sample(found, 6):
        for byte, bit in ((0, 0), (0, 1), (0, 3), (0, 7), (1, 2), (4, 4)):  # opcode, length
            damaged = bytearray(data)
            damaged[start + byte] ^= 1 << bit
            path.write_bytes(damaged)
            assert_all_equal(read(path)[0], episodes)


def test_a_missing_chunk_is_named_with_its_place_and_its_messages(chunked):
    path, episodes = chunked
    data = path.read_bytes()
    chunks = [(start, end) for kind, start, end in records(data) if kind == CHUNK]
    start, end = chunks[len(chunks) // 2 + 1]
    path.write_bytes(data[:start] + bytes(end - start) + data[end:])
    assert check_damaged(path, episodes) == 'part'
    found, texts = read(path)
    assert len(found) >= 8
    told = ' '.join(texts)
    assert f'chunk at byte {start}, log time ' in told
    gone, all_of_them = re.search(
        r'messages are missing: .*?(\d+) of (\d+) of topic /camera/image_raw', told).groups()
    beside = re.search(r'(\d+) frames beside what is lost', told)
    assert sum(map(len, found)) + int(gone) + int(beside[1] if beside else 0) == int(all_of_them)
    with pytest.warns(RecordingWarning, match=f'chunk at byte {start}'):  # from the cache
        assert_all_equal(open_recordings(path), found)


def rewrite(path, other, **options):
    """Copy the messages of a file as another writer would write them, an attachment behind."""
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
        writer.add_attachment(0, 5, 'notes.txt', 'text/plain', b'skipped')
        writer.finish()
    return other


def test_other_ways_to_write_mcap(tmp_path, chunked):
    path, episodes = chunked
    for options in (
            {'use_chunking': False}, {'index_types': IndexType.NONE},
            {'compression': CompressionType.NONE, 'enable_crcs': False},
            {'compression': CompressionType.LZ4, 'repeat_schemas': False},
            {'repeat_channels': False, 'repeat_schemas': False, 'use_statistics': False},
            {'use_summary_offsets': False, 'use_statistics': False, 'repeat_channels': False,
             'repeat_schemas': False, 'index_types': IndexType.NONE}):
        found, texts = read(rewrite(path, tmp_path / 'other.mcap', chunk_size=3000, **options))
        assert_all_equal(found, episodes)
        assert not texts, options


@pytest.mark.parametrize('compression', CompressionType)
def test_a_chunk_that_the_file_ends_in_is_read_up_to_there(compression, tmp_path):
    episodes = [make_episode(i, T=20, size=(64, 64), start=(i + 1) * 10**10) for i in range(2)]
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        for episode in episodes:
            writer.write(episode)
    path = rewrite(writer.path, tmp_path / 'b.mcap', chunk_size=10**9, compression=compression)
    data = path.read_bytes()
    end = next(end for kind, _, end in records(data) if kind == CHUNK)
    for share in (0.95, 0.5):
        path.write_bytes(data[:int(share * end)])
        found, texts = read(path)
        for episode in found:
            check_part(episode, episodes)
        assert any('cut off at byte' in text for text in texts)
        assert sum(map(len, found)) > 40 * (share - 0.3)  # compressed blocks are of 128 kB
    path.write_bytes(data[:end // 1000])
    with pytest.raises(RecordingError, match='holds no message.*the file is cut off'):
        list(open_recordings(path))


def test_a_chunk_that_claims_to_hold_what_no_recording_holds_is_refused(tmp_path):
    for content, claimed, words in (
            (100, mcap_file.MAX_CHUNK_BYTES + 1, 'claims to unpack to'),
            (50 * 2**20, 1000, 'more than it claims')):
        packed = zstandard.compress(bytes(content))
        record = struct.pack('<QQQII', 0, 0, claimed, 0, 4) + b'zstd' + (
            struct.pack('<Q', len(packed)) + packed)
        (tmp_path / 'a.mcap').write_bytes(
            b'\x89MCAP0\r\n' + struct.pack('<BQ', CHUNK, len(record)) + record)
        with pytest.raises(RecordingError, match=f'a.mcap: .*chunk .*{words}'):
            open_recordings(tmp_path)
