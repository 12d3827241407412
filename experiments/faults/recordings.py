# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Faults of recordings: what is whole is read, what is not is named, nothing hangs or crashes."""

import io
import os

from experiments.faults.children import Reader
from experiments.faults.fault import Fault
from experiments.faults.made_files import (
    CHUNK,
    chunk_bomb,
    MAGIC,
    message_bomb,
    records,
    rewrite,
    write_recording,
)
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk, StreamReader
import numpy as np
from tap_ros.recording.messages import encode
from tap_ros.recording.writer import write_metadata

SLOW_S = 5.0  # for files of some kilobytes
BOMB_MB = 1024
IMAGE = 'sensor_msgs/msg/Image'


class Known:
    """
    A recording that is whole, and what has to come of damaged copies.

    :param path: .mcap file.
    :param reader: Reader.
    """

    def __init__(self, path, reader):
        self.path, self.data = path, path.read_bytes()
        found = reader.read('recording', path)
        if found['error'] or found['warnings']:
            raise AssertionError(f'the whole recording: {found["error"] or found["warnings"]}')
        self.episodes = found['content']
        self.frames = {frame for _, frames in self.episodes for frame in frames}

    def share(self, found):
        """Return the share of the frames that was read, in percent."""
        read = {frame for _, frames in found['content'] or () for frame in frames}
        return 100.0 * len(read & self.frames) / len(self.frames)

    def judge(self, found, name, readable=False):
        """
        Say what is wrong with an answer; an empty string if nothing is.

        :param found: dict of Reader.read.
        :param name: of the file that the warnings have to name.
        :param readable: whether so much is whole that refusing the file is wrong.
        """
        if found['error'] is not None:
            if not found['expected']:
                return f'{found["kind"]}: {found["error"]}'
            return one_line(found['error'], name) or (
                f'the whole file is refused: {_without(found["error"], self.path)}'
                if readable else '')
        if found['seconds'] > SLOW_S:
            return f'took {found["seconds"]:.0f} s'
        for words in found['warnings']:
            if wrong := one_line(words, name):
                return wrong
        foreign = [frame for _, frames in found['content'] for frame in frames
                   if frame not in self.frames]
        if foreign:
            return f'{len(foreign)} pictures were read that are not in the recording'
        if not found['warnings'] and found['content'] != self.episodes:
            lost = len(self.episodes) - len(found['content'])
            return f'{lost} episodes are missing without a word' if lost > 0 else (
                'what was read differs from the recording without a word')
        return ''


def one_line(words, name):
    """Say what is wrong with an error or a warning; an empty string if nothing is."""
    if '\n' in words:
        return f'not one line: {words}'
    if name not in words:
        return f'does not name {name}: {words}'
    return '' if words.isprintable() else f'not escaped: {words!r}'


def _without(words, path):
    return words.replace(str(path.parent), '')


def pictures_by_chunk(data):
    """Return where each chunk of a whole file ends, and how many pictures are in it."""
    ends = [at + length for at, opcode, length in records(data) if opcode == CHUNK]
    topics, counts = {}, []
    for chunk in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if isinstance(chunk, Chunk):
            inside = breakup_chunk(chunk)
            topics |= {one.id: one.topic for one in inside if isinstance(one, Channel)}
            counts.append(sum(topics[one.channel_id] == '/camera/image_raw'
                              for one in inside if isinstance(one, Message)))
    return list(zip(ends, counts, strict=True))


def every_cut(job):
    """Read a file that ends anywhere."""
    path = job.folder / 'cut.mcap'
    with Reader() as reader:
        write_recording(path, episodes=2, length=3, chunk_bytes=2048)
        known = Known(path, reader)
        whole = pictures_by_chunk(known.data)
        lengths = range(0, len(known.data), max(1, round(1 / job.share)))
        job.expect(len(lengths))
        shares = []
        for length in lengths:
            path.write_bytes(known.data[:length])
            found = reader.read('recording', path)
            there = sum(count for end, count in whole if end <= length)
            why = known.judge(found, path.name, readable=there > 0)
            shares.append(known.share(found))
            if not why and shares[-1] < 100.0 * there / len(known.frames) - 0.01:
                why = f'{shares[-1]:.0f} % was read, though {there} pictures are in whole chunks'
            job.record(not why, why, found['seconds'])
    job.note = f'{np.mean(shares):.0f} % of the pictures read on average'


def flips(job):
    """Read a file with one bit flipped."""
    path = job.folder / 'flipped.mcap'
    with Reader() as reader:
        write_recording(path)
        known = Known(path, reader)
        for _ in job.trials():
            at = int(job.random.integers(len(known.data)))
            data = bytearray(known.data)
            data[at] ^= 1 << int(job.random.integers(8))
            path.write_bytes(data)
            found = reader.read('recording', path)
            why = known.judge(found, path.name, readable=at >= len(MAGIC))
            job.record(not why, why, known.share(found))
    job.note = f'{min(job.figures):.0f} % at least'


def opcodes(job):
    """Read a file where the kind of a chunk's record is another one."""
    def change(data, position, _):
        data[position] = int(job.random.choice([0, 3, 4, 5, 9, 15, 99, 200]))
    _chunks(job, change, lost=False)  # the summary says where it is, so it can be read


def missing_chunks(job):
    """Read a file where a chunk is gone."""
    def change(data, position, length):
        del data[position:position + length]
    _chunks(job, change, lost=True)


def _chunks(job, change, lost):
    path = job.folder / 'chunks.mcap'
    with Reader() as reader:
        write_recording(path)
        known = Known(path, reader)
        chunks = [(at, length) for at, opcode, length in records(known.data) if opcode == CHUNK]
        for _ in job.trials():
            data = bytearray(known.data)
            change(data, *chunks[job.random.integers(len(chunks))])
            path.write_bytes(data)
            found = reader.read('recording', path)
            why = known.judge(found, path.name, readable=True)
            if lost and not why and found['content'] == known.episodes:
                why = 'everything was read though a chunk is gone'
            job.record(not why, why, known.share(found))


def bad_pictures(job):
    """Read a recording in which one picture cannot be used."""
    picture = {'header': {'stamp': {'sec': 10}, 'frame_id': 'camera'}, 'height': 16, 'width': 16,
               'encoding': 'rgb8', 'step': 48, 'data': bytes(768)}
    changes = ({'height': 32, 'width': 32, 'step': 96, 'data': bytes(3072)},
               {'encoding': 'rgb16', 'step': 96, 'data': bytes(1536)},
               {'height': 0, 'width': 0, 'step': 0, 'data': b''}, {'step': 47},
               {'data': bytes(7)}, {'encoding': 'no\nsuch\x1b[31m'}, {'height': 2**31})
    path, whole = job.folder / 'picture.mcap', job.folder / 'good.mcap'
    with Reader() as reader:
        write_recording(whole)
        known = Known(whole, reader)
        count = len(known.frames)
        for trial in job.trials():
            bad = encode(IMAGE, {**picture, **changes[trial % len(changes)]})
            place = int(job.random.integers(count))
            rewrite(whole, path, change=lambda topic, index, data, bad=bad, place=place: [
                bad if (topic, index) == ('/camera/image_raw', place) else data])
            found = reader.read('recording', path)
            why = known.judge(found, path.name, readable=True)
            if not why and not found['warnings']:
                why = 'a picture is missing without a word'
            job.record(not why, why, known.share(found))


def metadata(job):
    """Read a bag whose metadata.yaml is nonsense."""
    bag = job.folder / 'bag'
    bag.mkdir()
    write_recording(bag / 'bag_0.mcap')
    write_metadata(bag)
    file = bag / 'metadata.yaml'
    good = file.read_text()
    key = 'relative_file_paths:'
    head, tail = good[:good.index(key)], good[good.index(key):]
    rest = '\n'.join(tail.split('\n')[2:])
    nonsense = [
        f'{head}{key} null\n{rest}', f'{head}{key} 7\n{rest}', f'{head}{key} [7]\n{rest}',
        f'{head}{key} [[bag_0.mcap]]\n{rest}', f'{head}{key} [../../../etc/passwd]\n{rest}',
        '[' * 200_000, '{a: ' * 200_000, '- ' * 200_000, '', '7', 'null', '[]', '&a [*a]',
        'a: &a [' + 'x,' * 9 + ']\n' + '\n'.join(
            f'{chr(98 + i)}: &{chr(98 + i)} [{", ".join([f"*{chr(97 + i)}"] * 9)}]'
            for i in range(9)),
        good.replace('rosbag2_bagfile_information', 'x\\x1b[31m'), '\x00' * 100,
        good.replace('nanoseconds', 'nothing'), '!!python/object/apply:os.system [true]']
    with Reader() as reader:
        whole = reader.read('recording', bag)
        for trial in job.trials():
            file.write_text(nonsense[trial % len(nonsense)])
            found = reader.read('recording', bag)
            why = ''
            if found['error'] is not None:
                why = (one_line(found['error'], bag.name) if found['expected']
                       else f'{found["kind"]}: {found["error"]}')
            elif not found['warnings'] and found['content'] != whole['content']:
                why = 'what was read differs from the recording without a word'
            job.record(not why, why, found['seconds'])


def fifos(job):
    """Read a pipe instead of a file: nothing ever comes."""
    with Reader() as reader:
        for trial in job.trials():
            folder = job.folder / f'pipe{trial}'
            folder.mkdir()
            path = folder / 'pipe.mcap'
            os.mkfifo(path)
            target = path if trial % 2 else folder
            found = reader.read('recording', target)
            why = _refusal(found, path.name if trial % 2 else folder.name)
            job.record(not why, why, found['seconds'])


def bombs(job):
    """Read files of some kilobytes that unpack to a great deal."""
    made = (lambda: message_bomb(2_000_000), lambda: message_bomb(500_000, bytes(8)),
            lambda: chunk_bomb(2**40, bytes(100)), lambda: chunk_bomb(1000, bytes(2**28)),
            lambda: chunk_bomb(2**29, bytes(2**29)))
    peak = 0.0
    for trial in job.trials():
        path = job.folder / 'bomb.mcap'
        path.write_bytes(made[trial % len(made)]())
        with Reader() as reader:
            reader.read('recording', os.devnull)
            found = reader.read('recording', path, 60.0)
        why = _refusal(found, path.name)
        if not why and found['peak_mb'] > BOMB_MB:
            why = f'{path.stat().st_size} bytes took {found["peak_mb"]:.0f} MB'
        if not why and found['seconds'] > SLOW_S:
            why = f'{path.stat().st_size} bytes took {found["seconds"]:.0f} s'
        peak = max(peak, found['peak_mb'])
        job.record(not why, why, found['seconds'])
    job.note = f'{peak:.0f} MB at most'


def _refusal(found, name):
    """Say why an answer is no clear refusal."""
    if found['error'] is None:
        return 'read as if it were a recording'
    if not found['expected']:
        return f'{found["kind"]}: {found["error"]}'
    return one_line(found['error'], name)


NAMED = 'What is whole is read; what is not is named in one line; no crash, no hang.'
FAULTS = [
    Fault('recording-cuts', 'a recording that ends anywhere', 'The computer lost power, or the '
          'copy was interrupted: the recording lacks its end.', NAMED, 9000, 0.004, every_cut,
          'to read it', 's'),
    Fault('recording-flips', 'one bit of a recording flipped', 'A bad disk or cable changed a '
          'recording. Whoever trains on it must not get other pictures without a word.',
          f'{NAMED} Past its first {len(MAGIC)} bytes one flip does not cost the whole file.',
          20_000, 0.012, flips, 'pictures still read', '%', 'mean'),
    Fault('recording-opcodes', 'a chunk with another record type', 'The same, where the flip hits '
          'the byte that says what follows: readers skip what they do not know.', NAMED,
          200, 0.012, opcodes, 'pictures still read', '%', 'mean'),
    Fault('recording-missing-chunks', 'a chunk of a recording gone', 'Part of a file was lost and '
          'the rest joined.', NAMED, 100, 0.012, missing_chunks, 'pictures still read', '%',
          'mean'),
    Fault('recording-pictures', 'one picture that cannot be used', 'A camera changed its size or '
          'encoding for a moment while it was recorded.',
          f'{NAMED} One picture does not cost the recording.', 70, 0.02, bad_pictures,
          'pictures still read', '%', 'mean'),
    Fault('recording-metadata', 'nonsense in metadata.yaml', 'The file that lists the parts of a '
          'bag was edited by hand, or damaged.', 'Refused in one line, or read with a warning. '
          'The .mcap files can be read without it.', 72, 0.1, metadata, 'to read it', 's'),
    Fault('recording-pipes', 'a pipe instead of a file', 'Something that is no file bears the '
          'name of a recording.', 'Refused in one line instead of waiting for ever.', 10, 0.1,
          fifos, 'to refuse it', 's'),
    Fault('recording-bombs', 'kilobytes that unpack to gigabytes', 'A file from elsewhere was '
          'made to exhaust the memory.', f'Refused in one line within {SLOW_S:g} s and '
          f'{BOMB_MB} MB.', 20, 3.0, bombs, 'to refuse it', 's')]
