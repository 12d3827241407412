# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files that appear complete or not at all, folders that one process writes to at a time.

A kill or a full disk leaves what was there before: the old file stays until the new one is whole.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
import errno
import fcntl
from io import BufferedWriter
import json
import os
from pathlib import Path
import stat
from typing import Any

from tap_ros.base.errors import StorageError
from tap_ros.base.text import escaped

_NOT_OF_STORAGE = (errno.ENOENT, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ECONNRESET)


def write_atomically(path: str | Path, data: bytes | bytearray | memoryview | str) -> None:
    """
    Write a file in one step; an existing one is replaced.

    :param path: of the file; its folder is made.
    :param data: bytes, or str that is written as UTF-8.
    :raises StorageError: when it cannot be written. An existing file is then what it was.
    """
    path = Path(path)
    part = path.with_name(f'{path.name}.part')
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open_alone(part) as stream:
            try:
                stream.write(data.encode() if isinstance(data, str) else data)
                stream.flush()
                os.fsync(stream.fileno())
                os.replace(part, path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
        with suppress(OSError):  # the name of a new file, too, where the file system can
            handle = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


def write_rows(path: str | Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """
    Write a table as JSON in one step, a row a line, so that changes can be read.

    :param path: of the file; its folder is made.
    :param rows: iterable of dicts.
    :raises StorageError: when it cannot be written. An existing file is then what it was.
    """
    write_atomically(path, '[\n' + ',\n'.join(map(json.dumps, rows)) + '\n]\n')


@contextmanager
def storage_errors(path: str | Path) -> Iterator[None]:
    """
    Turn what the system says about storage into one line.

    :param path: the file or folder that is named.
    :raises StorageError: for an OSError from the block.
    """
    try:
        yield
    except BrokenPipeError:  # nobody reads the output any more
        raise
    except OSError as error:
        place = escaped(error.filename or path)
        reason = escaped(error.strerror or error)
        raise StorageError(
            f'{place}: cannot be used: {reason}; mend that, then start again'
            if error.errno in _NOT_OF_STORAGE else
            f'{escaped(path)}: cannot be written: {reason}; make room or choose another place, '
            'then start again') from error


@contextmanager
def only_writer(folder: str | Path) -> Iterator[None]:
    """
    Be the only process that writes to a folder, as long as the context lasts.

    :param folder: made if it is not there.
    :raises StorageError: when another process is writing there, or the folder cannot be made.
    """
    with _locked(Path(folder), Path(folder), os.O_RDONLY | os.O_DIRECTORY,
                 'is writing there; wait until it has ended, or choose another folder'):
        yield


@contextmanager
def only_keeper(path: str | Path) -> Iterator[None]:
    """
    Be the only process that keeps a file, as long as the context lasts.

    :param path: of the file; a lock file is made beside it, and stays.
    :raises StorageError: when another process keeps it, or its folder cannot be written to.
    """
    path = Path(path).resolve()
    flags = os.O_RDONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    with _locked(path, path.with_name(f'.{path.name}.lock'), flags,
                 'keeps it; end that one, or choose another file'):
        yield


@contextmanager
def _locked(path: Path, lock: Path, flags: int, busy: str) -> Iterator[None]:
    """Hold the lock of a path; busy says what another process does that holds it."""
    with storage_errors(path):
        (lock if flags & os.O_DIRECTORY else lock.parent).mkdir(parents=True, exist_ok=True)
        handle = os.open(lock, flags, 0o666)
    try:
        if not _lock(handle, wait=False):
            raise StorageError(f'{escaped(path)}: another process {busy}')
        yield
    finally:
        os.close(handle)


def free_folder(wanted: str | Path) -> Path:
    """Return this folder, or the first one with a number added that does not exist."""
    folder, number = Path(wanted), 1
    while folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        number += 1
        folder = Path(f'{wanted}-{number}')
    return folder


def _lock(handle: int, wait: bool) -> bool:
    """Lock an open file or folder; say whether it could be."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:  # some network file systems have no locks
        pass
    return True


def open_alone(part: Path) -> BufferedWriter:
    """
    Open a file, empty, that no other process writes at once; one left by a kill serves.

    The folder may be a stranger's: what is no regular file, or another file's second name, is not
    written to.

    :raises StorageError: when it is such.
    """
    other = StorageError(f'{escaped(part)}: is a link, or no regular file; remove it, then start '
                         'again')
    while True:
        try:
            stream = open(part, 'ab', opener=_without_links)
        except OSError as error:
            raise (other if error.errno in (errno.ELOOP, errno.ENXIO) else error) from None
        _lock(stream.fileno(), wait=True)
        try:
            found = os.fstat(stream.fileno())
            if os.path.samestat(found, os.lstat(part)):
                if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                    raise other
                stream.truncate(0)
                return stream
        except FileNotFoundError:  # another process has given it its name in the meantime
            pass
        except BaseException:
            stream.close()
            raise
        stream.close()


def _without_links(path: str, flags: int) -> int:
    """Open a file, but not where a link leads; wait for no reader of a pipe."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
