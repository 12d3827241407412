# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is attached to an MCAP file, by whomever: read, and written into a folder."""

from collections.abc import Iterator
from dataclasses import dataclass
import itertools
from pathlib import Path
import re
import zlib

from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex
from tap_ros.errors import RecordingError
from tap_ros.files import storage_errors
from tap_ros.recording.chunks import read_record
from tap_ros.recording.container import McapFile
from tap_ros.recording.records import Records
from tap_ros.recording.summary import MAGIC, read_summary, RECORD
from tap_ros.text import escaped

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
    Yield the attachments of a file, in its order, where its summary lists them by that.

    :param path: of an .mcap file, whole or damaged.
    :return: iterator over Attached; one is in memory at a time.
    :raises RecordingError: when the file is missing, empty, no regular file, or not MCAP.
    """
    data = McapFile(path).data
    summary, _ = read_summary(data)
    if summary is None or not summary.placed or summary.attachments is None:
        records = Records(data, summary, lambda *_: None, lambda *_: None)
        for _ in records.parts(indexed=False):
            pass
        yield from (_read(data[start:end]) for start, end in records.attachments)
        return
    left = summary.start  # an index may name the same bytes again and again
    for entry in sorted(summary.attachments, key=lambda entry: entry.offset):
        start, end = entry.offset + RECORD.size, entry.offset + entry.length
        if start < len(MAGIC) + RECORD.size or not start <= end <= summary.start or (
                RECORD.unpack_from(data, entry.offset) != (Opcode.ATTACHMENT, end - start)):
            yield _unusable('it is not where the summary says', entry)
        elif entry.length > left:
            yield _unusable('the summary lists it again', entry)
        else:
            left -= entry.length
            yield _read(data[start:end], entry)


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


def _read(content: memoryview, entry: AttachmentIndex | None = None) -> Attached:
    """Read the content of an attachment record; entry: what the summary says of it."""
    if len(content) > MAX_BYTES:
        return _unusable(f'it has {len(content)} bytes; at most {MAX_BYTES} are read', entry)
    try:
        found = read_record(Attachment, content, whole=True)
    except RecordingError as error:
        return _unusable(str(error), entry)
    crc = int.from_bytes(content[-4:], 'little')
    wrong = crc and zlib.crc32(content[:-4]) != crc
    return Attached(
        found.name, found.media_type, found.log_time, len(found.data),
        None if wrong else found.data,
        'its checksum is wrong; restore the file from a copy' if wrong else '')


def _unusable(why: str, entry: AttachmentIndex | None) -> Attached:
    """Return what is known of an attachment that cannot be read."""
    if entry is None:
        return Attached('', '', 0, 0, None, why)
    return Attached(escaped(entry.name), entry.media_type, entry.log_time, entry.data_size, None,
                    why)
