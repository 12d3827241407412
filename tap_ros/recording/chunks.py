# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Unpack the chunks of MCAP files, and never into more memory than is sane."""

import struct
import zlib

import numpy as np
from tap_ros.errors import RecordingError
import zstandard

MAX_CHUNK_BYTES = 256 * 2**20  # a chunk that claims to unpack to more is refused
_CHUNK_START = struct.Struct('<QQQII')  # start, end, unpacked size, crc, length of compression


def claimed_size(view):
    """Return the number of bytes that the content of a chunk record claims to unpack to."""
    return _CHUNK_START.unpack_from(view)[2] if len(view) >= _CHUNK_START.size else 0


def unpack(view, buffer):
    """
    Return the checked bytes of a chunk.

    :param view: memoryview of the content of a chunk record.
    :param buffer: uint8 array to unpack into; one of our own takes its place when it is too small.
    :return: (bytes as a uint8 array, the buffer for the next chunk).
    :raises RecordingError: when its checksum is wrong, it does not unpack, or claims to unpack to
        more than MAX_CHUNK_BYTES.
    """
    try:
        _, _, size, crc, length = _CHUNK_START.unpack_from(view)
        compression = bytes(view[_CHUNK_START.size:_CHUNK_START.size + length]).decode()
        (packed,) = struct.unpack_from('<Q', view, _CHUNK_START.size + length)
    except (struct.error, UnicodeDecodeError) as error:
        raise RecordingError(f'it is damaged: {error}') from error
    body = view[_CHUNK_START.size + length + 8:]
    if len(body) != packed:
        raise RecordingError(f'it has {len(body)} of {packed} bytes')
    if size > MAX_CHUNK_BYTES:
        raise RecordingError(
            f'it claims to unpack to {size} bytes; at most {MAX_CHUNK_BYTES} are accepted')
    if compression == '':
        data = np.frombuffer(body, np.uint8)
    else:
        if len(buffer) < size:
            buffer = np.empty(size + size // 8, np.uint8)
        data = buffer[:_decompress(compression, body, memoryview(buffer)[:size])]
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise RecordingError('its checksum or size is wrong; restore the file from a copy')
    return data, buffer


def _decompress(compression, body, out):
    """Unpack a chunk into a buffer; return the number of bytes, never more than fit."""
    try:
        if compression == 'zstd':
            with zstandard.ZstdDecompressor().stream_reader(
                    body, read_size=max(len(body), 1)) as reader:
                size = reader.readinto(out) if len(out) else 0
                if reader.read(1):
                    raise RecordingError('it unpacks to more than it claims')
            return size
        if compression == 'lz4':
            import lz4.frame  # comes with mcap; few recordings need it
            data = lz4.frame.LZ4FrameDecompressor().decompress(body, max_length=len(out))
            out[:len(data)] = data
            return len(data)
    except (zstandard.ZstdError, RuntimeError) as error:
        raise RecordingError(f'it does not unpack: {error}') from error
    raise RecordingError(
        f'it is compressed as {compression[:40]!r}; zstd, lz4 and none can be read')
