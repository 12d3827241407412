# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Picture messages to arrays and back; what cannot be used is refused with the reason."""

import array
from collections.abc import Collection, Sequence
import sys
from typing import TYPE_CHECKING

import numpy as np
from sensor_msgs.msg import CompressedImage, Image
from tap_ros.contract import MAP_ENCODING, MASK_ENCODING, MAX_PICTURE_BYTES, PICTURE_ENCODING
from tap_ros.errors import ImageError
from tap_ros.images.encodings import decompress, pixel_bytes, to_rgb
from tap_ros.images.picture_files import wrong_mask_value
from tap_ros.images.pixels import check_image, resize_image
from tap_ros.text import escaped

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time

MAX_FRAME_ID = 100  # characters; it comes back with every picture and map of an answer


def is_empty(message: Image) -> bool:
    """Tell whether an image field was left as it is by default."""
    return message.width == 0 and message.height == 0 and len(message.data) == 0


def encode_image(image: np.ndarray, stamp: 'Time', frame_id: str) -> Image:
    """
    Turn a picture into a message.

    :param image: uint8 (H, W, 3) rgb.
    :param stamp: builtin_interfaces/Time, the moment of the snapshot.
    :param frame_id: frame of the camera.
    :return: sensor_msgs/Image in PICTURE_ENCODING.
    :raises ImageError: for another type or shape.
    """
    return _pack(check_image(image, 'image'), PICTURE_ENCODING, stamp, frame_id)


def encode_map(values: np.ndarray, stamp: 'Time', frame_id: str) -> Image:
    """
    Turn one object map into a message.

    :param values: float32 (H, W).
    :param stamp: builtin_interfaces/Time.
    :param frame_id: frame of the camera.
    :return: sensor_msgs/Image in MAP_ENCODING.
    """
    return _pack(np.asarray(values, np.float32), MAP_ENCODING, stamp, frame_id)


def encode_mask(mask: np.ndarray, stamp: 'Time', frame_id: str) -> Image:
    """
    Turn a robot mask into a message.

    :param mask: uint8 (H, W), values as in contract.py.
    :param stamp: builtin_interfaces/Time, that of the picture.
    :param frame_id: frame of the camera.
    :return: sensor_msgs/Image in MASK_ENCODING.
    """
    return _pack(mask, MASK_ENCODING, stamp, frame_id)


def decode_image(message: Image | CompressedImage, name: str, size: Sequence[int] | None = None,
                 resize: bool = False) -> np.ndarray:
    """
    Turn a message into a picture.

    :param message: sensor_msgs/Image in one of encodings.READABLE, rows may be padded; or
        sensor_msgs/CompressedImage.
    :param name: how an error calls it, for example 'goal'.
    :param size: the (height, width) wanted, or None for any.
    :param resize: resize to `size` instead of refusing another size.
    :return: uint8 (H, W, 3) rgb.
    :raises ImageError: for another encoding, size, step or length, and for more than
        MAX_PICTURE_BYTES.
    """
    try:
        if isinstance(message, CompressedImage):
            _check_length(message, name)
            image = decompress(np.frombuffer(message.data, np.uint8), message.format)
        else:
            channels = pixel_bytes(message.encoding)
            image = to_rgb(_rows(message, name, channels).reshape(
                message.height, message.width, channels), message.encoding)
    except ImageError as error:
        raise error if str(error).startswith(f'{name}: ') else ImageError(
            f'{name}: {error}') from error
    if resize and size is not None and image.shape[:2] != tuple(size):
        return resize_image(image, size)
    return check_image(image, name, size)


def decode_map(message: Image, name: str, size: Sequence[int] | None = None) -> np.ndarray:
    """
    Turn a message into an object map.

    :param message: sensor_msgs/Image in MAP_ENCODING.
    :param name: how an error calls it.
    :param size: the (height, width) wanted, or None for any.
    :return: float32 (H, W).
    :raises ImageError: for another encoding, size, step or length, or values that are not finite.
    """
    _check_encoding(message, name, (MAP_ENCODING,))
    if size is not None and (message.height, message.width) != tuple(size):
        raise ImageError(f'{name}: expected {size[1]}x{size[0]} pixels (width x height), '
                         f'got {message.width}x{message.height}')
    rows = np.ascontiguousarray(_rows(message, name, 4))
    values = rows.view('>f4' if message.is_bigendian else '<f4').astype(np.float32)
    if not np.isfinite(values).all():
        raise ImageError(f'{name}: holds NaN or infinity; expected finite numbers')
    return values


def decode_mask(message: Image, name: str, size: Sequence[int]) -> np.ndarray:
    """
    Turn a message into a robot mask.

    :param message: sensor_msgs/Image in MASK_ENCODING; rows may be padded.
    :param name: how an error calls it.
    :param size: the (height, width) of its picture.
    :return: uint8 (H, W) of contract.ROBOT_MASK_FREE, _HAND and _ARM.
    :raises ImageError: for another encoding, size, step, length or value.
    """
    _check_encoding(message, name, (MASK_ENCODING,))
    if (message.height, message.width) != tuple(size):
        raise ImageError(f'{name}: expected {size[1]}x{size[0]} pixels (width x height) like its '
                         f'picture, got {message.width}x{message.height}')
    mask = np.ascontiguousarray(_rows(message, name, 1))
    wrong = wrong_mask_value(mask)
    if wrong is not None:
        raise ImageError(f'{name}: {wrong}')
    return mask


def _check_encoding(message: Image, name: str, valid: Collection[str]) -> None:
    """Refuse another encoding than the valid ones."""
    if message.encoding not in valid:
        raise ImageError(f"{name}: encoding '{escaped(message.encoding, 40)}' cannot be used; "
                         f'valid encodings: {", ".join(valid)}')


def _rows(message: Image, name: str, bytes_per_pixel: int) -> np.ndarray:
    """Check the layout and return uint8 (height, width * bytes_per_pixel) without padding."""
    height, width, step = message.height, message.width, message.step
    _check_length(message, name)
    if height == 0 or width == 0:
        raise ImageError(f'{name}: is empty ({width}x{height} pixels); send a whole image')
    row_bytes = width * bytes_per_pixel
    if step < row_bytes:
        raise ImageError(
            f'{name}: step is {step} bytes, but {width} pixels of {message.encoding} take '
            f'{row_bytes}; step must be at least that')
    if len(message.data) != step * height:
        raise ImageError(
            f'{name}: data has {len(message.data)} bytes, expected step * height = '
            f'{step} * {height} = {step * height}')
    data = np.frombuffer(message.data, np.uint8).reshape(height, step)
    return data[:, :row_bytes]


def _check_length(message: Image | CompressedImage, name: str) -> None:
    """Refuse a message that is longer than any of use."""
    if len(message.data) > MAX_PICTURE_BYTES:
        raise ImageError(f'{name}: data has {len(message.data)} bytes; at most '
                         f'{MAX_PICTURE_BYTES} are taken, send a smaller picture')
    if len(message.header.frame_id) > MAX_FRAME_ID:
        raise ImageError(f'{name}: frame_id has {len(message.header.frame_id)} characters; '
                         f'at most {MAX_FRAME_ID} are taken')


def _pack(values: np.ndarray, encoding: str, stamp: 'Time', frame_id: str) -> Image:
    """Fill a message with rows that are not padded."""
    values = np.ascontiguousarray(values)
    message = Image()
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    message.height, message.width = values.shape[:2]
    message.encoding = encoding
    message.is_bigendian = int(sys.byteorder == 'big')
    message.step = values.nbytes // values.shape[0]
    # Any other type than array.array is checked byte by byte, which takes milliseconds.
    message.data = array.array('B', values.tobytes())
    return message
