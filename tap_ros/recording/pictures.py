# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pixels of sensor_msgs/Image messages, whatever their encoding and padding."""

from typing import Any

import numpy as np
from tap_ros.contract import ENCODINGS, PICTURE_ENCODING
from tap_ros.errors import RecordingError


def read_pixels(message: Any) -> np.ndarray:
    """
    Return the pixels of an image message, (H, W, 3) uint8 rgb; H = W = 0 when it holds none.

    :param message: sensor_msgs/Image as messages.decode returns it.
    :raises RecordingError: when it cannot be read or contradicts itself.
    """
    height, width, step, encoding = message.height, message.width, message.step, message.encoding
    length = len(message.data)
    channels, order = ENCODINGS.get(encoding, (0, (0, 0, 0)))
    if length == height * width == 0:
        return np.empty((0, 0, 3), np.uint8)
    if not channels:
        raise RecordingError(
            f'encoding {encoding[:40]!r} cannot be read; choose one of {", ".join(ENCODINGS)}')
    if height * width == 0 or step < width * channels or length != height * step:
        raise RecordingError(
            f'a {encoding} image of {width}x{height} pixels with step {step} and {length} '
            f'bytes of data; expected a step of at least {width * channels} and '
            'step * height bytes')
    pixels = message.data.reshape(height, step)[:, :width * channels].reshape(height, width, -1)
    if encoding != PICTURE_ENCODING:
        pixels = pixels[..., list(order)]
    return np.ascontiguousarray(pixels)
