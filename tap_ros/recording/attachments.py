# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is attached to an MCAP file, by whomever: read, and written into a folder."""

from collections.abc import Iterator
from dataclasses import dataclass
import itertools
from pathlib import Path
import re
import zlib

from mcap.records import Attachment
from tap_ros.errors import RecordingError
from tap_ros.files import storage_errors
from tap_ros.recording.damage import describe
from tap_ros.recording.mcap_file import McapFile, read_record

MAX_BYTES = 2**28  # of one attachment that is read
MAX_NAME = 100  # characters of a file's name


@dataclass(frozen=True)
class Attached:
    """
    An attachment; its texts are as they stand in the file.

    :param log_time: ns, when it was recorded.
    :param data: its bytes; None when they cannot be used, and damage says why.
    """

    name: str
    media_type: str
    log_time: int
    size: int
    data: bytes | None
    damage: str = ''


def read_attachments(path: str | Path) -> Iterator[Attached]:
    """
    Yield the attachments of a file, in its order, as far as its records can be told apart.

    :param path: of an .mcap file, whole or damaged.
    :return: iterator over Attached; one is in memory at a time.
    :raises RecordingError: when the file is missing, empty, no regular file, or not MCAP.
    """
    file = McapFile(path)
    yield from map(_read, file.attachments())
    for line in describe(file.losses):
        yield Attached('', '', 0, 0, None, line)


def save_attachment(attached: Attached, folder: str | Path) -> Path:
    """
    Write an attachment into a folder, under a name that no file there has.

    :param attached: with data.
    :param folder: made if it is not there.
    :return: of the file: the attachment's name, without folders and all that names of files
        better lack; with a number where that is taken.
    :raises StorageError: when it cannot be written.
    """
    assert attached.data is not None
    name = Path(safe_name(attached.name))
    with storage_errors(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            path = Path(folder, name if number == 1 else f'{name.stem}-{number}{name.suffix}')
            try:
                stream = open(path, 'xb')
            except FileExistsError:
                continue
            try:
                with stream:
                    stream.write(attached.data)
            except BaseException:
                path.unlink()
                raise
            return path
    raise AssertionError('there are always more numbers')


def safe_name(name: str) -> str:
    """Return a file's name without folders, leading dots and unusual characters; never empty."""
    base = re.sub(r'[^A-Za-z0-9._-]+', '_', re.split(r'[/\\]', name)[-1]).lstrip('.-')
    path = Path(base or 'attachment')
    suffix = path.suffix[:MAX_NAME // 2]
    return path.stem[:MAX_NAME - len(suffix)] + suffix


def _read(content: memoryview) -> Attached:
    """Read the content of an attachment record."""
    if len(content) > MAX_BYTES:
        return Attached('', '', 0, 0, None,
                        f'it has {len(content)} bytes; at most {MAX_BYTES} are read')
    try:
        found = read_record(Attachment, content)
    except RecordingError as error:
        return Attached('', '', 0, 0, None, str(error))
    crc = int.from_bytes(content[-4:], 'little')
    wrong = crc and zlib.crc32(content[:-4]) != crc
    return Attached(
        found.name, found.media_type, found.log_time, len(found.data),
        None if wrong else found.data,
        'its checksum is wrong; restore the file from a copy' if wrong else '')
