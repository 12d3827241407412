# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings and weights to damage: small, but with all that real ones have."""

from io import BytesIO
import struct

from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
from tap_ros.recording.episode import Episode
from tap_ros.recording.writer import EpisodeWriter
import zstandard

MAGIC = b'\x89MCAP0\r\n'
CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 6, 7, 8  # opcodes of MCAP records


def make_episode(seed, length=6, size=(16, 16)):
    """Return an Episode of random numbers with two objects and a goal."""
    random = np.random.default_rng(seed)
    actions = random.uniform(-0.08, 0.08, (length, 4)).astype(np.float32)
    actions[-1] = 0
    return Episode(
        frames=random.integers(0, 256, (length, *size, 3), np.uint8),
        stamps=(seed + 1) * 10**10 + np.arange(length) * 250_000_000, actions=actions,
        grippers=random.normal(size=(length, 4)).astype(np.float32),
        object_names=('red', 'green'),
        object_pixels=random.uniform(0, 16, (length, 2, 2)).astype(np.float32),
        object_poses=random.normal(size=(length, 2, 7)),
        goal_frame=random.integers(0, 256, (*size, 3), np.uint8),
        goal_pixels=random.uniform(0, 16, (2, 2)).astype(np.float32),
        goal_poses=random.normal(size=(2, 7)), task='push2', seed=seed, outcome='success')


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
            writer.write(make_episode(seed, length, (size, size)))
    rewrite(whole, path, chunk_bytes)
    whole.unlink()


def rewrite(source, path, chunk_bytes=8192, change=lambda topic, index, data: [data]):
    """
    Copy a recording, with other chunks and perhaps other messages.

    :param source: .mcap file.
    :param path: of the copy.
    :param chunk_bytes: size at which a chunk is finished.
    :param change: called with topic, number of the message in its topic, and its bytes; returns
        the list of messages that take its place.
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
            for data in change(channel.topic, index, message.data):
                writer.add_message(
                    ids[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()


def records(data):
    """Return (position, opcode, length with head) of every record of an MCAP file."""
    found, position = [], len(MAGIC)
    while position + 9 <= len(data) - len(MAGIC):
        opcode, length = struct.unpack_from('<BQ', data, position)
        found.append((position, opcode, length + 9))
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
    from tap_ros.recording.messages import schema_text
    out = BytesIO()
    writer = Writer(out, chunk_size=2**26, index_types=IndexType.NONE,
                    compression=CompressionType.ZSTD)
    writer.start('ros2')
    kind = 'sensor_msgs/msg/Image'
    schema = writer.register_schema(kind, 'ros2msg', schema_text(kind).encode())
    channel = writer.register_channel('/camera/image_raw', 'cdr', schema)
    for _ in range(messages):
        writer.add_message(channel, 1, data, 1)
    writer.finish()
    return out.getvalue()
