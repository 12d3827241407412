# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pixels of recorded picture messages, whatever their encoding and padding."""

from typing import Any

import numpy as np
from tap_ros.contract import (
    MASK_ENCODING,
    ROBOT_MASK_ARM,
    ROBOT_MASK_FREE,
    ROBOT_MASK_HAND,
)
from tap_ros.errors import ImageError, RecordingError
from tap_ros.images.encodings import decompress, pixel_bytes, to_rgb

_MASK_VALUES = (ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM)
_IS_MASK_VALUE = np.isin(np.arange(256), _MASK_VALUES)


def read_pixels(message: Any) -> np.ndarray:
    """
    Return the pixels of an image message, (H, W, 3) uint8 rgb; H = W = 0 when it holds none.

    :param message: sensor_msgs/Image as messages.decode returns it.
    :raises RecordingError: when it cannot be read or contradicts itself.
    """
    if _is_empty(message):
        return np.empty((0, 0, 3), np.uint8)
    try:
        return to_rgb(_rows(message, pixel_bytes(message.encoding)), message.encoding)
    except ImageError as error:
        raise RecordingError(str(error)) from error


def read_compressed(message: Any) -> np.ndarray:
    """
    Return the pixels of a compressed image message, (H, W, 3) uint8 rgb; see read_pixels.

    :param message: sensor_msgs/CompressedImage as messages.decode returns it.
    :raises RecordingError: when it cannot be read.
    """
    if not len(message.data):
        return np.empty((0, 0, 3), np.uint8)
    try:
        return decompress(message.data, message.format)
    except ImageError as error:
        raise RecordingError(str(error)) from error


def read_mask(message: Any) -> np.ndarray:
    """
    Return the pixels of a robot mask, (H, W) uint8; H = W = 0 when it holds none.

    :param message: sensor_msgs/Image as messages.decode returns it.
    :raises RecordingError: when it cannot be read, contradicts itself, or holds other values.
    """
    if _is_empty(message):
        return np.empty((0, 0), np.uint8)
    if message.encoding != MASK_ENCODING:
        raise RecordingError(f'encoding {message.encoding[:40]!r} is not that of a robot mask; '
                             f'expected {MASK_ENCODING}')
    mask = np.ascontiguousarray(_rows(message, 1)[..., 0])
    wrong = wrong_mask_value(mask)
    if wrong is not None:
        raise RecordingError(wrong)
    return mask


def wrong_mask_value(mask: np.ndarray) -> str | None:
    """
    Say what is wrong with the values of a robot mask, None if nothing is.

    :param mask: uint8, any shape.
    """
    right = _IS_MASK_VALUE[mask]
    if right.all():
        return None
    return (f'a robot mask with the value {mask[~right][0]}; expected {ROBOT_MASK_FREE} (free), '
            f'{ROBOT_MASK_HAND} (hand) or {ROBOT_MASK_ARM} (arm)')


def _is_empty(message: Any) -> bool:
    return len(message.data) == message.height * message.width == 0


def _rows(message: Any, channels: int) -> np.ndarray:
    """Return uint8 (H, W, channels), without padding; RecordingError for a wrong layout."""
    height, width, step = message.height, message.width, message.step
    length = len(message.data)
    if height * width == 0 or step < width * channels or length != height * step:
        raise RecordingError(
            f'a {message.encoding} image of {width}x{height} pixels with step {step} and {length} '
            f'bytes of data; expected a step of at least {width * channels} and '
            'step * height bytes')
    return message.data.reshape(height, step)[:, :width * channels].reshape(height, width, -1)
