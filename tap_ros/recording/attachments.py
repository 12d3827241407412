# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files attached to MCAP files: goal pictures and model cards that recordings carry beside messages.

`NewAttachments` picks them out of the traffic, `read_attachments` reads what anybody attached.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import itertools
from pathlib import Path
import re
import zlib

from mcap.records import Attachment
from tap_ros.contract import MAX_PICTURE_BYTES
from tap_ros.errors import ImageError, RecordingError
from tap_ros.files import storage_errors
from tap_ros.messages.images import decode_image, is_empty
from tap_ros.messages.topics import GOAL_IMAGE
from tap_ros.recording.damage import describe
from tap_ros.recording.mcap_file import McapFile, read_record
from tap_ros.recording.messages import decode

MAX_BYTES = 2**28  # of one attachment that is read
MAX_NAME = 100  # characters of a file's name
CARD = '/model_card'  # how topics of model cards end
CARD_TYPE = 'std_msgs/msg/String'
MAX_CARD_BYTES = 2**20
MAX_NEW_BYTES = 2**26  # of all that is attached to one file
MAX_SIDE = 2**15  # px of a picture; far above what cameras have, below what a PNG can have


@dataclass(frozen=True)
class Attached:
    """
    An attachment; its texts are as they stand in the file.

    :param log_time: ns, when it was recorded.
    :param data: its bytes; None when they cannot be used, and damage says why.
    """

    name: str = ''
    media_type: str = ''
    log_time: int = 0
    size: int = 0
    data: bytes | None = None
    damage: str = ''


def read_attachments(path: str | Path) -> Iterator[Attached]:
    """
    Yield the attachments of a file, in its order, as far as its records can be told apart.

    :param path: of an .mcap file, whole or damaged.
    :return: iterator over Attached; one is in memory at a time.
    :raises RecordingError: when the file is missing, empty, no regular file, or not MCAP.
    """
    file = McapFile(path)
    for content in file.attachments():
        try:
            if len(content) > MAX_BYTES:
                raise RecordingError(
                    f'it has {len(content)} bytes; at most {MAX_BYTES} are read')
            found = read_record(Attachment, content)
        except RecordingError as error:
            yield Attached(damage=str(error))
            continue
        crc = int.from_bytes(content[-4:], 'little')
        wrong = crc and zlib.crc32(content[:-4]) != crc
        yield Attached(
            found.name, found.media_type, found.log_time, len(found.data),
            None if wrong else found.data,
            'its checksum is wrong; restore the file from a copy' if wrong else '')
    for line in describe(file.losses):
        yield Attached(damage=line)


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
    name = _safe_name(attached.name)
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


def _safe_name(name: str) -> Path:
    """Return a file's name without folders, leading dots and unusual characters; never empty."""
    base = re.sub(r'[^A-Za-z0-9._-]+', '_', re.split(r'[/\\]', name)[-1]).lstrip('.-')
    path = Path(base or 'attachment')
    suffix = path.suffix[:MAX_NAME // 2]
    return Path(path.stem[:MAX_NAME - len(suffix)] + suffix)


class NewAttachments:
    """Tells for each message of one recorded file what is to be attached with it."""

    def __init__(self) -> None:
        self._newest: dict[str, bytes] = {}  # by name
        self._room = MAX_NEW_BYTES

    def new(self, topic: str, type_name: str, data: bytes, log_time: int) -> Attachment | None:
        """
        Return the goal picture (goal.png) or model card in a message, with its namespace in front.

        None for all else: for a goal or card that equals the one before it, that cannot be read,
        or for which there is no more room (MAX_NEW_BYTES).

        :param topic: full name; those that count end in /goal/image or /model_card.
        :param type_name: for example 'sensor_msgs/msg/Image'.
        :param data: the serialized message (CDR).
        :param log_time: ns, when it was received.
        """
        created = 0
        try:
            if GOAL_IMAGE.is_called(topic) and type_name == GOAL_IMAGE.type:
                name, kind = f'{topic.removesuffix(GOAL_IMAGE.recorded)}/goal.png', 'image/png'
                content, created = _goal(data)
            elif topic.endswith(CARD) and type_name == CARD_TYPE:
                name, kind = f'{topic}.md', 'text/markdown'
                content = decode(CARD_TYPE, data).data.encode()
            else:
                return None
        except (RecordingError, ImageError):  # whoever reads the recording is told
            return None
        most = min(self._room, MAX_CARD_BYTES if name.endswith('.md') else self._room)
        if not 0 < len(content) <= most or self._newest.get(name) == content:
            return None
        self._newest[name] = content
        self._room -= len(content)
        return Attachment(created, log_time, name.strip('/').replace('/', '_'), kind, content)


def _goal(data: bytes) -> tuple[bytes, int]:
    """Return the picture of a message as PNG and its stamp, ns; b'' without one to be shown."""
    message = decode(GOAL_IMAGE.type, data)
    if len(message.data) > MAX_PICTURE_BYTES or max(message.height, message.width) > MAX_SIDE:
        return b'', 0
    if is_empty(message):
        return b'', 0
    picture = decode_image(message)
    from tap_ros.images.drawing import png_bytes  # cv2 takes a moment, and few files have a goal
    stamp = message.header.stamp
    return png_bytes(picture), max(stamp.sec * 10**9 + stamp.nanosec, 0)
