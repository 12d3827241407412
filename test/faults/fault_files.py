# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings to damage, and child processes that read them within limits of time and memory."""

import hashlib
from io import BytesIO
import multiprocessing
import os
from pathlib import Path
import signal
import struct
import time
import traceback
import warnings

from made_episodes import make_episode
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from tap_ros.errors import TapError
from tap_ros.recording.messages import schema_text
from tap_ros.recording.writer import EpisodeWriter
import zstandard

MAGIC = b'\x89MCAP0\r\n'
CHUNK = 6  # opcode of an MCAP record
IMAGE = 'sensor_msgs/msg/Image'


def write_recording(path, episodes=12, length=6, size=16, chunk_bytes=8192):
    """
    Write a recording with many small chunks, as a long one has many large ones.

    :param path: of the .mcap file.
    :param episodes: how many.
    :param length: pictures of each.
    :param size: their width and height.
    :param chunk_bytes: size at which a chunk is finished.
    """
    whole = path.with_name('whole.mcap')
    with EpisodeWriter(whole) as writer:
        for seed in range(episodes):
            writer.write(make_episode(seed, length, size=(size, size), start=(seed + 1) * 10**10))
    rewrite(whole, path, chunk_bytes)
    whole.unlink()


def rewrite(source, path, chunk_bytes=8192, change=lambda topic, index, data: data):
    """
    Copy a recording, with other chunks and perhaps other messages.

    :param source: .mcap file.
    :param path: of the copy.
    :param chunk_bytes: size at which a chunk is finished.
    :param change: called with topic, number of the message in its topic, and its bytes; returns
        those that take their place.
    """
    ids, counts = {}, {}
    with open(path, 'wb') as out, open(source, 'rb') as stream:
        writer = Writer(out, chunk_size=chunk_bytes, index_types=IndexType.ALL,
                        compression=CompressionType.ZSTD)
        writer.start('ros2')
        for schema, channel, message in NonSeekingReader(stream).iter_messages(
                log_time_order=False):
            if channel.topic not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(
                    channel.topic, 'cdr', number, channel.metadata)
            index = counts[channel.topic] = counts.get(channel.topic, -1) + 1
            writer.add_message(ids[channel.topic], message.log_time,
                               change(channel.topic, index, message.data), message.publish_time)
        writer.finish()


def chunk_records(data):
    """Return (position, length with head) of every chunk of an MCAP file."""
    found, position = [], len(MAGIC)
    while position + 9 <= len(data) - len(MAGIC):
        opcode, length = struct.unpack_from('<BQ', data, position)
        if opcode == CHUNK:
            found.append((position, length + 9))
        position += length + 9
    return found


def chunk_bomb(claimed, content):
    """Return a file of one zstd chunk that unpacks to `content`, or claims to."""
    packed = zstandard.compress(content)
    head = struct.pack('<QQQII', 0, 0, claimed, 0, 4) + b'zstd' + struct.pack('<Q', len(packed))
    record = head + packed
    return MAGIC + struct.pack('<BQ', CHUNK, len(record)) + record


def message_bomb(messages, data=b''):
    """Return a small file with a great number of tiny messages on the picture topic."""
    out = BytesIO()
    writer = Writer(out, chunk_size=2**26, index_types=IndexType.NONE,
                    compression=CompressionType.ZSTD)
    writer.start('ros2')
    schema = writer.register_schema(IMAGE, 'ros2msg', schema_text(IMAGE).encode())
    channel = writer.register_channel('/camera/image_raw', 'cdr', schema)
    for _ in range(messages):
        writer.add_message(channel, 1, data, 1)
    writer.finish()
    return out.getvalue()


# What the process of a Reader does


def read_recording(path):
    """Return what a recording holds: for each episode a hash of the whole and of each frame."""
    from tap_ros.recording.reader import iter_episodes
    episodes = []
    for episode in iter_episodes(path):
        whole = hashlib.sha1()
        for field in vars(episode).values():
            whole.update(field.tobytes() if hasattr(field, 'tobytes') else repr(field).encode())
        frames = [hashlib.sha1(frame.tobytes() + stamp.tobytes()).hexdigest()[:12]
                  for frame, stamp in zip(episode.frames, episode.stamps)]
        episodes.append([whole.hexdigest(), frames])
    return episodes


def read_weights(path):
    """Return a hash of what a weights file makes the planner's forward model compute with."""
    from tap_ros.planning.forward_model import LearnedForwardModel
    model = LearnedForwardModel.load(path, precision='float32')
    found = hashlib.sha1(repr(model.config).encode())
    for name, tensor in sorted(model.state_dict().items()):
        found.update(name.encode() + tensor.contiguous().numpy().tobytes())
    return found.hexdigest()


def read_predictor(path):
    """Load the network of a predictor; return what its training says of itself."""
    from tap_ros.prediction.predictor import load_network
    return sorted(load_network(path)[1])


READERS = {'recording': read_recording, 'weights': read_weights, 'predictor': read_predictor}


def answer(pipe):
    """Answer what to read and a file by what came of it, again and again."""
    while True:
        what, path = pipe.recv()
        begin = time.monotonic()
        found = {'content': None, 'error': None, 'kind': None, 'expected': False}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always')
            try:
                found['content'] = READERS[what](path)
            except Exception as error:
                last = traceback.extract_tb(error.__traceback__)[-1]
                found |= {'error': str(error), 'expected': isinstance(error, TapError), 'kind': (
                    f'{type(error).__name__} in {Path(last.filename).name}:{last.lineno}')}
        # getrusage would count its parent's memory.
        peak_kb = Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0]
        pipe.send(found | {'warnings': [str(warning.message) for warning in caught],
                           'seconds': time.monotonic() - begin, 'peak_mb': int(peak_kb) / 1024})


class Reader:
    """A process that reads files, started anew whenever one has ended it."""

    def __init__(self):
        self._process = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.end()

    def read(self, what, path, timeout_s=10.0):
        """
        Read a file.

        :param what: a key of READERS.
        :param path: the file.
        :param timeout_s: after so long it is a hang, and the process is killed.
        :return: the dict of answer.
        :raises AssertionError: if the file ends or hangs the process.
        """
        if self._process is None:
            context = multiprocessing.get_context('spawn')
            self._pipe, other = context.Pipe()
            self._process = context.Process(target=answer, args=(other,), daemon=True)
            self._process.start()
            other.close()
            self._ask(what, os.devnull, 120.0)  # what is imported on the way is not timed
        return self._ask(what, path, timeout_s)

    def _ask(self, what, path, timeout_s):
        try:
            self._pipe.send((what, str(path)))
            if self._pipe.poll(timeout_s):
                return self._pipe.recv()
        except (EOFError, OSError) as error:
            self._process.join(5.0)
            raise AssertionError(f'crash: {describe_exit(self.end())}') from error
        self.end()
        raise AssertionError(f'hang: no answer in {timeout_s:g} s')

    def end(self):
        """End the process; return its exit code."""
        if self._process is None:
            return None
        self._process.kill()
        self._process.join()
        self._pipe.close()
        code, self._process = self._process.exitcode, None
        return code


def describe_exit(code):
    """Return an exit code in words."""
    if code is not None and code < 0:
        return f'ended by {signal.Signals(-code).name}'
    return f'exit code {code}'


def assert_refused(found, name):
    """Raise AssertionError unless a file was refused by a TapError in one line that names it."""
    assert found['error'] is not None, 'accepted'
    assert found['expected'], f'{found["kind"]}: {found["error"]}'
    assert_one_line(found['error'], name)


def assert_one_line(words, name):
    """Raise AssertionError unless an error or a warning is one printable line with a name."""
    assert words.isprintable(), f'not one printable line: {words!r}'
    assert name in words, f'does not name {name}: {words}'
