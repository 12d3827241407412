# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bytes of recorded files, unpacked where they were packed as a whole; what others are."""

import mmap
import os
from pathlib import Path
import re
import shlex
import stat

from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.recording.trust import Budget
import zstandard

PACKED = '.zstd', '.zst'  # behind the name of a file that was compressed as a whole
_NOT_OURS = {  # by how a file begins: what it is, and the command that makes it readable
    b'\x1f\x8b': ('packed by gzip', 'gzip -dk {}'), b'BZh': ('packed by bzip2', 'bzip2 -dk {}'),
    b'\xfd7zXZ': ('packed by xz', 'xz -dk {}'), b'\4"M\x18': ('packed by lz4', 'lz4 -dk {}'),
    b'PK\3\4': ('a zip archive', 'unzip {}'),
    b'version https://git-lfs': ('what Git LFS left in place of the file', 'git lfs pull')}


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


def unpacked_name(path: Path) -> str:
    """Return the name of a file without the ending of what compressed it."""
    return path.stem if path.suffix in PACKED else path.name


def what_else(path: Path) -> str:
    """Return why a file cannot be read as it is, and the command that helps; '' if unknown."""
    try:
        with open(path, 'rb') as stream:
            start = stream.read(32)
    except OSError:
        return ''
    what, command = next((told for magic, told in _NOT_OURS.items() if start.startswith(magic)),
                         ('', ''))
    if 'packed' in what and re.search(r'[.](tar[.]\w+|tgz)$', path.name):
        command = 'tar -xf {}'
    place = shlex.quote(escaped(path, 400))
    return what and f'it is {what}; type `{command.format(place)}`'
