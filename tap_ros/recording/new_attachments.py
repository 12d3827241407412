# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What of the traffic a recording carries as files, too: goal pictures and model cards."""

from dataclasses import dataclass

from tap_ros.contract import MAX_PICTURE_BYTES
from tap_ros.errors import RecordingError
from tap_ros.images.picture_files import read_pixels
from tap_ros.recording import topics
from tap_ros.recording.messages import decode

CARD = '/model_card'  # how topics of model cards end
CARD_TYPE = 'std_msgs/msg/String'
PNG, MARKDOWN = 'image/png', 'text/markdown'
MAX_CARD_BYTES = 2**20
MAX_BYTES = 2**26  # of all that is attached to one file
MAX_SIDE = 2**15  # px of a picture; far above what cameras have, below what a PNG can have


@dataclass(frozen=True)
class NewAttachment:
    """What is to be attached; created_ns: when it was made, 0 where nothing tells."""

    name: str
    media_type: str
    data: bytes
    created_ns: int


class NewAttachments:
    """Tells for each message of one recorded file what is to be attached with it."""

    def __init__(self) -> None:
        self._newest: dict[str, bytes] = {}  # by name
        self._room = MAX_BYTES

    def new(self, topic: str, type_name: str, data: bytes) -> NewAttachment | None:
        """
        Return the goal picture (goal.png) or model card in a message, with its namespace in front.

        None for all else: for a goal or card that equals the one before it, that cannot be read,
        or for which there is no more room (MAX_BYTES).

        :param topic: full name; those that count end in /goal/image or /model_card.
        :param type_name: for example 'sensor_msgs/msg/Image'.
        :param data: the serialized message (CDR).
        """
        if topic.endswith(topics.GOAL_IMAGE) and type_name == topics.TYPES[topics.GOAL_IMAGE]:
            make, name = _goal, f'{topic.removesuffix(topics.GOAL_IMAGE)}/goal.png'
        elif topic.endswith(CARD) and type_name == CARD_TYPE:
            make, name = _card, f'{topic}.md'
        else:
            return None
        try:
            file = make(name.strip('/').replace('/', '_'), data)
        except RecordingError:  # whoever reads the recording is told
            return None
        if file is None or len(file.data) > self._room or self._newest.get(name) == file.data:
            return None
        self._newest[name] = file.data
        self._room -= len(file.data)
        return file


def _goal(name: str, data: bytes) -> NewAttachment | None:
    """Return the picture in a message as PNG; None for an empty one, which takes back the goal."""
    message = decode(topics.TYPES[topics.GOAL_IMAGE], data)
    if len(message.data) > MAX_PICTURE_BYTES or max(message.height, message.width) > MAX_SIDE:
        return None
    picture = read_pixels(message)
    if not picture.size:
        return None
    from tap_ros.images.drawing import png_bytes  # cv2 takes a moment, and few files have a goal
    stamp = message.header.stamp
    return NewAttachment(name, PNG, png_bytes(picture), max(stamp.sec * 10**9 + stamp.nanosec, 0))


def _card(name: str, data: bytes) -> NewAttachment | None:
    """Return the text in a message."""
    text = decode(CARD_TYPE, data).data.encode()
    return NewAttachment(name, MARKDOWN, text, 0) if 0 < len(text) <= MAX_CARD_BYTES else None
