# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Copies of files that cannot be read as they are: packed ones, and sqlite3 with logs beside it.

A copy is made once, for this process and those that decode for it, and is gone in the end.
"""

from contextlib import closing
from multiprocessing.util import Finalize
import os
from pathlib import Path
import re
import shlex
import shutil
import sqlite3
import tempfile

from tap_ros.errors import RecordingError
from tap_ros.text import escaped
import zstandard

PACKED = '.zstd', '.zst'  # behind the name of a file that was compressed as a whole
_MOST = 8  # copies kept at once
copies: dict[tuple[object, ...], Path] = {}  # by the file's path, size and times
_NOT_OURS = {  # by how a file begins: what it is, and the command that makes it readable
    b'\x1f\x8b': ('packed by gzip', 'gzip -dk {}'), b'BZh': ('packed by bzip2', 'bzip2 -dk {}'),
    b'\xfd7zXZ': ('packed by xz', 'xz -dk {}'), b'\4"M\x18': ('packed by lz4', 'lz4 -dk {}'),
    b'PK\3\4': ('a zip archive', 'unzip {}'),
    b'version https://git-lfs': ('what Git LFS left in place of the file', 'git lfs pull')}


def readable(path: Path) -> Path:
    """
    Return a file as it is, or a copy that is whole by itself; what is there is not changed.

    :param path: of a regular file.
    :raises RecordingError: without room for a copy, and for one that does not unpack.
    """
    with open(path, 'rb') as stream:
        is_packed = stream.read(4) == zstandard.FRAME_HEADER
    beside = sqlite_logs(path)
    if not is_packed and not beside:
        return path
    key = tuple((str(file), file.stat().st_size, file.stat().st_mtime_ns)
                for file in (path.absolute(), *beside))
    if key not in copies or not copies[key].is_file():
        while len(copies) >= _MOST:
            _remove(copies.pop(next(iter(copies))))
        copies[key] = _copy(path, beside, is_packed)
    return copies[key]


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


def sqlite_logs(path: Path) -> list[Path]:
    """Return the files beside one of sqlite3 that hold a part of what was written to it."""
    logs = [path.with_name(path.name + end) for end in ('-wal', '-journal')]
    return [log for log in logs if log.is_file() and log.stat().st_size]


def _copy(path: Path, beside: list[Path], is_packed: bool) -> Path:
    """Make a copy in a folder of its own, which is named after this process."""
    try:
        folder = Path(tempfile.mkdtemp(prefix=f'tap_ros_{os.getpid()}_'))
        copy = folder / unpacked_name(path)
        for log in beside:
            shutil.copyfile(log, folder / log.name)
        with open(path, 'rb') as stream, open(copy, 'wb') as out:
            shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(
                stream, read_across_frames=True) if is_packed else stream, out)
    except OSError as error:
        raise RecordingError(
            f'{escaped(path)}: a copy is needed and cannot be made ({error.strerror}); let TMPDIR '
            'name a folder with space for it') from error
    except zstandard.ZstdError as error:
        raise RecordingError(f'{escaped(path)}: does not unpack: {escaped(error)}') from error
    if beside:
        with closing(sqlite3.connect(copy)) as base:
            base.execute('SELECT count(*) FROM sqlite_master').fetchall()  # rolls back
            base.execute('PRAGMA journal_mode=DELETE').fetchall()  # takes over what -wal holds
    return copy


def _remove(copy: Path) -> None:
    """Remove a copy, if this process made it."""
    if copy.parent.name.startswith(f'tap_ros_{os.getpid()}_'):
        shutil.rmtree(copy.parent, ignore_errors=True)


def _remove_all() -> None:
    for copy in copies.values():
        _remove(copy)


Finalize(None, _remove_all, exitpriority=1)  # also of processes that multiprocessing begins
