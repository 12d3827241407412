# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The rule for files that strangers made, whatever their format.

A reader opens regular files inside the folder that it was given, runs nothing that is in them, and
is bounded in memory and time.

What a user names is followed wherever its links lead. Links and names inside a folder are a
stranger's: they have to end in that folder or, where it is a snapshot in the cache of Hugging
Face's hub, in the cache of that data set, as its files are links to blobs beside it.
"""

import json
from pathlib import Path
from typing import Any

from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped

MOST_FRAMES = 10**5  # of a demonstration
MOST_BYTES = 2**32  # of its pictures, as they are kept
_FREE, _RATIO = 2**31, 1000  # bytes that a file may unpack to: so many, and so many times its own
_RECORD_BYTES = 4096  # that a record counts at least, however small it is


class Budget:
    """
    What may still be unpacked of a file.

    Each byte of a file of black pictures stands for some hundreds; more is made to fill memory.

    :param size: bytes of the file.
    """

    def __init__(self, size: int) -> None:
        self._left = _FREE + _RATIO * size

    def take(self, size: int, records: int = 0) -> None:
        """
        Use some of it.

        :param size: bytes that are to be unpacked.
        :param records: that are in them.
        :raises ValueError: when that is more than what is left, of which nothing is used then.
        """
        if size + _RECORD_BYTES * records > self._left:
            raise ValueError(f'the file unpacks to more than {_RATIO} times its size, and no '
                             'recording does')
        self._left -= size + _RECORD_BYTES * records


def regular(path: str | Path) -> Path:
    """
    Return the path of a regular file: a FIFO would be waited for, a device has no end.

    :raises RecordingError: when it is none.
    """
    path = Path(path)
    try:
        if path.is_file():
            return path
        what = 'is not there' if not path.exists() else 'is no regular file'
    except (OSError, ValueError) as error:
        what = f'cannot be read: {escaped(error)}'
    raise RecordingError(f'{escaped(path)} {what}')


def inside(folder: str | Path, name: str | Path) -> Path:
    """
    Return the regular file of a name that stands in a stranger's file, or of a link.

    :param folder: that was given.
    :param name: relative to it.
    :return: its path, absolute and without links, which no library takes for a URL.
    :raises RecordingError: when it is none, or leads out of the folder.
    """
    root = Path(folder).resolve()
    try:
        path = (root / name).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise RecordingError(f'{escaped(name)}: is no name of a file: {escaped(error)}') from error
    root = next((above.parent for above in root.parents if above.name == 'snapshots'
                 and (above.parent / 'blobs').is_dir()), root)
    if not path.is_relative_to(root):
        raise RecordingError(f'{escaped(name)} leads out of {escaped(folder)}; what is meant has '
                             'to be in there, or given by its own path')
    return regular(path)


def read_bytes(path: str | Path, most: int) -> bytes:
    """
    Return what a regular file holds.

    :param most: bytes.
    :raises RecordingError: when it is no regular file, or longer.
    :raises OSError: when it cannot be read.
    """
    with open(regular(path), 'rb') as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise RecordingError(f'{escaped(path)}: has more than {most} bytes')
    return data


def parse_json(data: bytes) -> Any:
    """
    Return what JSON text says.

    :raises ValueError: for other text, and for brackets in brackets without end.
    """
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError('its brackets are too deep') from None
