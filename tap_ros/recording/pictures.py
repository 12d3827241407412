# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pixels of sensor_msgs/Image messages, whatever their encoding and padding."""

from dataclasses import dataclass

import numpy as np
from tap_ros.contract import ENCODINGS, PICTURE_ENCODING
from tap_ros.errors import RecordingError


@dataclass(frozen=True)
class Picture:
    """How the pixels of an image message lie."""

    size: tuple  # (H, W)
    encoding: str
    step: int  # bytes from row to row

    @classmethod
    def of(cls, layout):
        """Read and check the description of a sensor_msgs/Image."""
        head = np.frombuffer(layout.example, np.uint8)[None]
        height, width, step = (
            layout.column(head, field).item() for field in ('height', 'width', 'step'))
        encoding, length = layout.strings['encoding'], layout.counts['data']
        channels, _ = ENCODINGS.get(encoding, (None, None))
        if length == height * width == 0:
            return cls((0, 0), encoding, 0)
        if channels is None:
            raise RecordingError(
                f'encoding {encoding[:40]!r} cannot be read; choose one of {", ".join(ENCODINGS)}')
        if height * width == 0 or step < width * channels or length != height * step:
            raise RecordingError(
                f'a {encoding} image of {width}x{height} pixels with step {step} and {length} '
                f'bytes of data; expected a step of at least {width * channels} and '
                'step * height bytes')
        return cls((height, width), encoding, step)

    def rgb(self, buffer, start):
        """Return a buffer of H * W * 3 bytes from the pixels that start somewhere in another."""
        height, width = self.size
        if 0 in self.size:
            return buffer[:0]
        data = buffer[start:start + height * self.step]
        channels, order = ENCODINGS[self.encoding]
        if self.encoding == PICTURE_ENCODING and self.step == channels * width:
            return data
        pixels = data.reshape(height, self.step)[:, :width * channels].reshape(height, width, -1)
        return np.ascontiguousarray(pixels[..., list(order)])
