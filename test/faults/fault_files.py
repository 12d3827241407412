# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings to damage, and child processes that read them within limits of time and memory."""

from dataclasses import dataclass
from io import BytesIO
import json
import os
from pathlib import Path
import resource
import select
import signal
import struct
import subprocess
import sys
import time

from made_episodes import make_episode
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from tap_ros.recording.messages import schema_text
from tap_ros.recording.writer import EpisodeWriter
import zstandard

ROOT = Path(__file__).parents[2]
READER = [sys.executable, str(Path(__file__).with_name('fault_reader.py'))]
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


class Reader:
    """The process of fault_reader.py, started anew whenever a file has ended it."""

    def __init__(self):
        self._process = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.end()

    def read(self, what, path, timeout_s=10.0):
        """
        Read a file.

        :param what: a key of fault_reader.READERS.
        :param path: the file.
        :param timeout_s: after so long it is a hang, and the process is killed.
        :return: the dict of fault_reader.answer.
        :raises AssertionError: if the file ends or hangs the process.
        """
        if self._process is None:
            self._process = subprocess.Popen(
                READER, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                cwd=ROOT, start_new_session=True)
            self._ask(what, os.devnull, 120.0)  # what is imported on the way is not timed
        return self._ask(what, path, timeout_s)

    def _ask(self, what, path, timeout_s):
        self._process.stdin.write((json.dumps([what, str(path)]) + '\n').encode())
        self._process.stdin.flush()
        if not select.select([self._process.stdout], [], [], timeout_s)[0]:
            self.end()
            raise AssertionError(f'hang: no answer in {timeout_s:g} s')
        line = self._process.stdout.readline()
        if not line:
            self._process.wait(5.0)
            raise AssertionError(f'crash: {describe_exit(self.end())}')
        return json.loads(line)

    def end(self):
        """End the process; return its exit code."""
        if self._process is None:
            return None
        end_group(self._process)
        self._process.stdin.close()
        self._process.stdout.close()
        code, self._process = self._process.returncode, None
        return code


@dataclass(frozen=True)
class Ended:
    """How a child process ended."""

    code: int | None  # None: it was killed after its time
    text: str  # what it printed
    seconds: float


def run_limited(command, timeout_s, file_bytes=None):
    """
    Run a command to its end.

    :param command: list of words.
    :param timeout_s: after so long all of its processes are killed.
    :param file_bytes: most bytes of any file that it writes; beyond, a write fails as it does on a
        full disk, though with another error number.
    :return: Ended.
    """
    def limit():
        if file_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
    begin = time.monotonic()
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        cwd=ROOT, start_new_session=True, preexec_fn=limit)
    try:
        text, _ = process.communicate(timeout=timeout_s)
        code = process.returncode
    except subprocess.TimeoutExpired:
        end_group(process)
        text, _ = process.communicate()
        code = None
    return Ended(code, text.decode(errors='replace'), time.monotonic() - begin)


def end_group(process):
    """Kill a process and all that it started, if it still runs."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


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
