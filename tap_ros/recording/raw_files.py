# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bytes of a file of a bag; one that was packed as a whole is unpacked in memory."""

import mmap
import os
from pathlib import Path
import stat

from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.recording.trust import Budget
import zstandard


def parts_of(path: Path) -> list[Path]:
    """Return what a file of a bag consists of: itself, and a log of sqlite's that it may have."""
    return [path, *filter(Path.is_file, [path.with_name(f'{path.name}-wal')])]


def stats_of(path: Path) -> tuple[tuple[int, ...], ...]:
    """
    Return what tells whether a file has changed: of each part bytes, inode, two times in ns.

    :raises RecordingError: when it is not there.
    """
    try:
        return tuple((one.st_size, one.st_ino, one.st_mtime_ns, one.st_ctime_ns)
                     for one in map(os.stat, parts_of(path)))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error


def beginning(path: Path) -> bytes:
    """Return how a file begins, unpacked; nothing of what is no file."""
    try:
        if path.is_file():  # opening a FIFO would wait for its writer
            with open(path, 'rb') as stream:
                start = stream.read(32)
                if not start.startswith(zstandard.FRAME_HEADER):
                    return start
                stream.seek(0)
                return zstandard.ZstdDecompressor().stream_reader(stream).read(32)
    except (OSError, zstandard.ZstdError):
        pass  # who reads it says why
    return b''


def bytes_of(path: str | Path) -> bytes | mmap.mmap:
    """
    Map a file into memory; one that was packed as a whole is unpacked there.

    :raises RecordingError: when it is missing, empty, no regular file, or does not unpack.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a FIFO would wait for its writer
            raise RecordingError(f'{path}: not a regular file; expected an .mcap file')
        with open(path, 'rb') as stream:
            start = stream.read(4)
            if start == zstandard.FRAME_HEADER:
                stream.seek(0)
                pieces, budget = [], Budget(os.fstat(stream.fileno()).st_size)
                reader = zstandard.ZstdDecompressor().stream_reader(
                    stream, read_across_frames=True)
                while piece := reader.read(2**20):
                    budget.take(len(piece))
                    pieces.append(piece)
                data = b''.join(pieces)
                if not data:
                    raise RecordingError(f'{path}: does not unpack: it is cut short')
            elif start:
                data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from error
    except (ValueError, zstandard.ZstdError, MemoryError) as error:
        raise RecordingError(f'{escaped(path)}: does not unpack: {escaped(error)}; unpack it with '
                             'zstd -d') from error
    if not start:
        raise RecordingError(f'{path}: the file is empty; it holds no message')
    return data
