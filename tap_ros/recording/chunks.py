# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The records of MCAP files, read by the mcap package, and chunks unpacked within limits."""

from io import BytesIO
import struct
from typing import TypeVar
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Chunk, McapRecord
from tap_ros.errors import RecordingError
import zstandard

Record = TypeVar('Record', bound=McapRecord)

MAX_CHUNK_BYTES = 256 * 2**20  # a chunk that claims to unpack to more is refused
DAMAGE = (McapError, struct.error, ValueError, OverflowError)  # what mcap raises for damaged bytes


def read_record(kind: type[Record], content: bytes | memoryview, whole: bool = False) -> Record:
    """
    Read the content of a record.

    :param kind: the class in mcap.records.
    :param content: bytes-like.
    :param whole: whether nothing may stand behind what is read.
    :return: of that class.
    :raises RecordingError: when it is damaged.
    """
    stream = ReadDataStream(BytesIO(content))
    try:
        record: Record = kind.read(stream)  # type: ignore[attr-defined]  # of each, not of all
    except DAMAGE as error:
        raise RecordingError(f'damaged {kind.__name__.lower()} record') from error
    if whole and stream.count != len(content):
        raise RecordingError(f'damaged {kind.__name__.lower()} record: wrong length')
    return record


def read_chunk(content: bytes | memoryview) -> Chunk:
    """
    Read the content of a chunk record without unpacking it.

    :param content: bytes-like.
    :return: mcap.records.Chunk.
    :raises RecordingError: when it is damaged, or claims to unpack to more than MAX_CHUNK_BYTES.
    """
    if len(content) > MAX_CHUNK_BYTES:
        raise RecordingError(
            f'it has {len(content)} bytes; at most {MAX_CHUNK_BYTES} are accepted')
    chunk = read_record(Chunk, content)
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise RecordingError(
            f'it claims to unpack to {chunk.uncompressed_size} bytes; at most {MAX_CHUNK_BYTES} '
            'are accepted')
    return chunk


def unpack(chunk: Chunk) -> bytes:
    """
    Return the checked bytes of a chunk, which never take more memory than it claims.

    :param chunk: as read_chunk returns it.
    :raises RecordingError: when its checksum or size is wrong, or it does not unpack.
    """
    try:
        data = _decompress(chunk.compression, chunk.data, chunk.uncompressed_size)
    except (zstandard.ZstdError, RuntimeError) as error:
        raise RecordingError(f'it does not unpack: {error}') from error
    crc = chunk.uncompressed_crc
    if len(data) != chunk.uncompressed_size or (crc and zlib.crc32(data) != crc):
        raise RecordingError('its checksum or size is wrong; restore the file from a copy')
    return data


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    if compression == '':
        return data
    if compression == 'zstd':
        # What the frame says about its size counts more for the decompressor than our limit.
        if zstandard.frame_content_size(data) not in (-1, size):
            raise RecordingError('it unpacks to more than it claims, or to less')
        return zstandard.ZstdDecompressor().decompress(data, size)
    if compression == 'lz4':
        import lz4.frame  # comes with mcap; few recordings need it
        return lz4.frame.LZ4FrameDecompressor().decompress(data, size)
    raise RecordingError(
        f'it is compressed as {compression[:40]!r}; zstd, lz4 and none can be read')
