# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of recordings: what is whole is read, what is not is named, nothing hangs or crashes."""

import io
import os

from fault_files import (
    assert_one_line,
    assert_refused,
    chunk_bomb,
    chunk_records,
    IMAGE,
    MAGIC,
    message_bomb,
    Reader,
    rewrite,
    write_recording,
)
from fault_report import fault
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk, StreamReader
import numpy as np
import pytest
from tap_ros.recording.messages import encode
from tap_ros.recording.writer import write_metadata

SLOW_S = 5.0  # for files of some kilobytes
BOMB_MB = 1024
NAMED = 'what is whole is read, the rest named in one line'


@pytest.fixture
def reader():
    """Return a Reader."""
    with Reader() as reader:
        yield reader


@pytest.fixture
def known(reader, tmp_path):
    """Return the Known of a recording of 12 episodes and many chunks."""
    write_recording(tmp_path / 'known.mcap')
    return Known(tmp_path / 'known.mcap', reader)


class Known:
    """
    A recording that is whole, and what has to come of damaged copies.

    :param path: .mcap file.
    :param reader: Reader.
    """

    def __init__(self, path, reader):
        self._reader, self.path, self.data = reader, path, path.read_bytes()
        self.copy = path.with_name('damaged.mcap')
        found = reader.read('recording', path)
        assert not found['error'] and not found['warnings'], found
        self.episodes = found['content']
        self.frames = {frame for _, frames in self.episodes for frame in frames}

    def judge(self, trials, readable, data=None):
        """
        Read a damaged copy, and raise AssertionError unless what comes of it is right.

        :param trials: gets the percentage of the pictures that was read.
        :param readable: whether so much is whole that refusing the file is wrong.
        :param data: bytes of the copy; None: the file is there.
        :return: dict of Reader.read.
        """
        if data is not None:
            self.copy.write_bytes(data)
        found = self._reader.read('recording', self.copy)
        read = [frame for _, frames in found['content'] or () for frame in frames]
        trials.measured(100.0 * len(set(read) & self.frames) / len(self.frames))
        if found['error'] is not None:
            assert_refused(found, self.copy.name)
            assert not readable, f'the whole file is refused: {found["error"]}'
            return found
        assert found['seconds'] < SLOW_S, f'took {found["seconds"]:.0f} s'
        for words in found['warnings']:
            assert_one_line(words, self.copy.name)
        assert set(read) <= self.frames, 'pictures were read that are not in the recording'
        assert found['warnings'] or found['content'] == self.episodes, (
            'what was read differs from the recording without a word')
        return found


def pictures_by_chunk(data):
    """Return where each chunk of a whole file ends, and how many pictures are in it."""
    ends = [at + length for at, length in chunk_records(data)]
    topics, counts = {}, []
    for chunk in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if isinstance(chunk, Chunk):
            inside = breakup_chunk(chunk)
            topics |= {one.id: one.topic for one in inside if isinstance(one, Channel)}
            counts.append(sum(topics[one.channel_id] == '/camera/image_raw'
                              for one in inside if isinstance(one, Message)))
    return list(zip(ends, counts, strict=True))


@fault('a recording that ends anywhere', NAMED, 27_000, '% of the pictures read (mean)',
       np.mean)
def test_recording_cuts(trials, reader, tmp_path):
    write_recording(tmp_path / 'short.mcap', episodes=2, length=3, chunk_bytes=2048)
    known = Known(tmp_path / 'short.mcap', reader)
    whole = pictures_by_chunk(known.data)
    for length in range(0, len(known.data), max(1, round(1 / trials.share))):
        with trials.one():
            there = sum(count for end, count in whole if end <= length)
            known.judge(trials, readable=there > 0, data=known.data[:length])
            share = trials.figures[-1]
            assert share >= 100.0 * there / len(known.frames) - 0.01, (
                f'{share:.0f} % was read, though {there} pictures are in whole chunks')


def flip(random, data):
    """Flip one bit; nothing that counts as whole is lost but by the first bytes."""
    at = int(random.integers(len(data)))
    data[at] ^= 1 << int(random.integers(8))
    return at >= len(MAGIC)


def rename_chunk(random, data):
    """Give a chunk another record type."""
    data[random.choice(chunk_records(data))[0]] = random.choice([0, 3, 4, 5, 9, 15, 99, 200])
    return True


def drop_chunk(random, data):
    """Take a chunk out."""
    at, length = random.choice(chunk_records(data))
    del data[at:at + length]
    return True


@pytest.mark.parametrize('damage', [pytest.param(damage, id=name, marks=fault(
    injected, promise, count, '% of the pictures read (mean)', np.mean))
    for name, injected, promise, count, damage in (
        ('recording-flips', 'one bit of a recording flipped',
         f'{NAMED}; past byte {len(MAGIC)} it does not cost the file', 20_000, flip),
        ('recording-opcodes', 'a chunk with another record type', NAMED, 200, rename_chunk),
        ('recording-missing-chunks', 'a chunk of a recording gone', NAMED, 100, drop_chunk))])
def test_(trials, known, damage):
    random = np.random.default_rng(0)
    for _ in trials:
        data = bytearray(known.data)
        readable = damage(random, data)
        with trials.one():
            found = known.judge(trials, readable, data)
            assert len(data) == len(known.data) or found['content'] != known.episodes, (
                'all was read though a chunk is gone')


@fault('one recorded picture that cannot be used', f'{NAMED}; it does not cost the recording', 70,
       '% of the pictures read (mean)', np.mean)
def test_recording_pictures(trials, known):
    random = np.random.default_rng(0)
    picture = {'header': {'stamp': {'sec': 10}, 'frame_id': 'camera'}, 'height': 16, 'width': 16,
               'encoding': 'rgb8', 'step': 48, 'data': bytes(768)}
    changes = ({'height': 32, 'width': 32, 'step': 96, 'data': bytes(3072)},
               {'encoding': 'rgb16', 'step': 96, 'data': bytes(1536)},
               {'height': 0, 'width': 0, 'step': 0, 'data': b''}, {'step': 47},
               {'data': bytes(7)}, {'encoding': 'no\nsuch\x1b[31m'}, {'height': 2**31})
    for trial in trials:
        bad = encode(IMAGE, {**picture, **changes[trial % len(changes)]})
        place = int(random.integers(len(known.frames)))
        rewrite(known.path, known.copy, change=lambda topic, index, data, bad=bad, place=place: (
            bad if (topic, index) == ('/camera/image_raw', place) else data))
        with trials.one():
            found = known.judge(trials, True)
            assert found['warnings'], 'a picture is missing without a word'


@fault('nonsense in metadata.yaml', 'refused in one line, or read with a warning', 72, 's', max)
def test_recording_metadata(trials, reader, tmp_path):
    bag = tmp_path / 'bag'
    bag.mkdir()
    write_recording(bag / 'bag_0.mcap')
    write_metadata(bag)
    file = bag / 'metadata.yaml'
    good = file.read_text()
    key = 'relative_file_paths:'
    head, tail = good[:good.index(key)], good[good.index(key):]
    rest = '\n'.join(tail.split('\n')[2:])
    nonsense = [
        *(f'{head}{key} {value}\n{rest}' for value in (
            'null', '7', '[7]', '[[bag_0.mcap]]', '[../../../etc/passwd]')),
        '[' * 200_000, '{a: ' * 200_000, '- ' * 200_000, '', '7', 'null', '[]', '&a [*a]',
        'a: &a [' + 'x,' * 9 + ']\n' + '\n'.join(
            f'{chr(98 + i)}: &{chr(98 + i)} [{", ".join([f"*{chr(97 + i)}"] * 9)}]'
            for i in range(9)),
        good.replace('rosbag2_bagfile_information', 'x\\x1b[31m'), '\x00' * 100,
        good.replace('nanoseconds', 'nothing'), '!!python/object/apply:os.system [true]']
    whole = reader.read('recording', bag)
    for trial in trials:
        file.write_text(nonsense[trial % len(nonsense)])
        with trials.one():
            found = reader.read('recording', bag)
            trials.measured(found['seconds'])
            if found['error'] is not None:
                assert_refused(found, bag.name)
            else:
                assert found['warnings'] or found['content'] == whole['content'], (
                    'what was read differs from the recording without a word')


@fault('a pipe instead of a recording', 'refused in one line instead of waiting for ever', 10,
       's', max)
def test_recording_pipes(trials, reader, tmp_path):
    for trial in trials:
        folder = tmp_path / f'pipe{trial}'
        folder.mkdir()
        os.mkfifo(folder / 'pipe.mcap')
        target = folder / 'pipe.mcap' if trial % 2 else folder
        with trials.one():
            found = reader.read('recording', target)
            trials.measured(found['seconds'])
            assert_refused(found, target.name)


@fault('kilobytes that unpack to gigabytes', f'refused in one line within {SLOW_S:g} s and '
       f'{BOMB_MB} MB', 20, 's', max)
def test_recording_bombs(trials, tmp_path):
    made = (lambda: message_bomb(2_000_000), lambda: message_bomb(500_000, bytes(8)),
            lambda: chunk_bomb(2**40, bytes(100)), lambda: chunk_bomb(1000, bytes(2**28)),
            lambda: chunk_bomb(2**29, bytes(2**29)))
    path, peak = tmp_path / 'bomb.mcap', 0.0
    for trial in trials:
        path.write_bytes(made[trial % len(made)]())
        with trials.one(), Reader() as reader:
            reader.read('recording', os.devnull)
            found = reader.read('recording', path, 60.0)
            trials.measured(found['seconds'])
            peak = max(peak, found['peak_mb'])
            assert_refused(found, path.name)
            assert found['peak_mb'] < BOMB_MB, f'took {found["peak_mb"]:.0f} MB'
            assert found['seconds'] < SLOW_S * trials.patience, f'took {found["seconds"]:.0f} s'
    trials.note = f'{peak:.0f} MB at most'
