# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of pictures, maps, masks and their camera to arrays and back."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import math
import sys
from typing import Any

import numpy as np
from tap_ros.base.contract import MAP_ENCODING, MASK_ENCODING, MAX_PICTURE_BYTES, PICTURE_ENCODING
from tap_ros.base.errors import ImageError
from tap_ros.base.text import escaped
from tap_ros.images.encodings import decompress, find_encoding, to_rgb
from tap_ros.images.pixels import check_image, check_mask
from tap_ros.messages.stamps import header_fields, Stamp

MAX_FRAME_ID = 100  # characters; it comes back with every picture and map of an answer
MAX_PIXELS = 2**24  # of a camera
JPEG_QUALITY = 95


def is_empty(message: Any) -> bool:
    """Return whether a message is as it is by default: no picture."""
    size = getattr(message, 'width', 0), getattr(message, 'height', 0)  # of one not compressed
    return size == (0, 0) and len(message.data) == 0


def decode_image(message: Any, name: str = '',
                 size: Sequence[int] | None = None) -> np.ndarray:
    """
    Turn a message into a picture.

    :param message: sensor_msgs/Image in one of encodings.ENCODINGS, rows may be padded; or
        sensor_msgs/CompressedImage.
    :param name: how an error calls it, for example 'goal'.
    :param size: the (height, width) wanted, or None for any.
    :return: uint8 (H, W, 3) rgb.
    :raises ImageError: for another encoding, size, step or length, and for more than
        MAX_PICTURE_BYTES.
    """
    with _named(name):
        _check_length(message)
        if hasattr(message, 'format'):
            if not len(message.data):
                raise ImageError('is empty; send a whole image')
            image = decompress(np.frombuffer(message.data, np.uint8), message.format)
        else:
            encoding = find_encoding(message.encoding)
            image = to_rgb(_rows(message, encoding.pixel_bytes, encoding.planes).reshape(
                -1, message.width, encoding.pixel_bytes), message.encoding)
    return check_image(image, name, size)


def decode_map(message: Any, name: str, size: Sequence[int] | None = None) -> np.ndarray:
    """
    Turn a message into an object map.

    :param message: sensor_msgs/Image in MAP_ENCODING, or mono8.
    :param name: how an error calls it.
    :param size: the (height, width) wanted, or None for any.
    :return: float32 (H, W); of mono8 it sums to 1.
    :raises ImageError: for another encoding, size, step or length, or values that are not finite.
    """
    with _named(name):
        if message.encoding == 'mono8':
            _check_kind(message, 'mono8', size)
            bright = _rows(message, 1).astype(np.float32)
            return np.asarray(bright / max(bright.sum(), 1))
        _check_kind(message, MAP_ENCODING, size)
        rows = np.ascontiguousarray(_rows(message, 4))
        values = rows.view('>f4' if message.is_bigendian else '<f4').astype(np.float32)
        if not np.isfinite(values).all():
            raise ImageError('holds NaN or infinity; expected finite numbers')
    return values


def decode_mask(message: Any, name: str = '', size: Sequence[int] | None = None) -> np.ndarray:
    """
    Turn a message into a robot mask.

    :param message: sensor_msgs/Image in MASK_ENCODING, rows may be padded; or
        sensor_msgs/CompressedImage, without loss.
    :param name: how an error calls it.
    :param size: the (height, width) of its picture, or None for any.
    :return: uint8 (H, W) of contract.ROBOT_MASK_FREE, _HAND and _ARM.
    :raises ImageError: for another encoding, size, step, length or value.
    """
    with _named(name):
        if hasattr(message, 'format'):
            grey, *colours = np.moveaxis(decode_image(message, size=size), -1, 0)
            if any((grey != each).any() for each in colours):
                raise ImageError('a robot mask with colours; expected one of greys, as PNG')
            return check_mask(np.ascontiguousarray(grey))
        _check_kind(message, MASK_ENCODING, size, ' like its picture')
        return check_mask(np.ascontiguousarray(_rows(message, 1)))


def decode_camera_info(message: Any, rectified: bool) -> tuple[np.ndarray, tuple[int, int]]:
    """
    Return the intrinsics of the pictures that a camera sends, after its region and binning.

    :param message: sensor_msgs/CameraInfo.
    :param rectified: the pictures are rectified: P counts, else K.
    :return: (3, 3) in pixels, and (height, width).
    :raises ImageError: for lenses that bend lines, and for numbers that no camera has.
    """
    name = 'camera/camera_info'
    if not rectified and any(message.d):
        raise ImageError(f'{name}: its lens bends straight lines (d is not zero); rectify the '
                         'pictures (image_proc), and set the parameter rectified')
    K = np.array(message.p if rectified else message.k).reshape(3, -1)[:, :3].copy()
    roi = message.roi
    region = (roi.height or message.height, roi.width or message.width)
    bins = np.array([max(message.binning_x, 1), max(message.binning_y, 1)])
    height, width = region[0] // int(bins[1]), region[1] // int(bins[0])
    K[:2, 2] -= roi.x_offset, roi.y_offset
    K[:2] /= bins[:, None]
    if not (np.isfinite(K).all() and (np.abs(K) < 1e6).all() and K[0, 0] > 0 and K[1, 1] > 0
            and np.array_equal(K[2], [0, 0, 1])):
        raise ImageError(f'{name}: {"p" if rectified else "k"} is not that of a camera; expected '
                         'focal lengths above 0 in pixels, and 0, 0, 1 in its last row')
    if not 0 < height * width <= MAX_PIXELS:
        raise ImageError(f'{name}: pictures of {width}x{height} pixels (width x height); expected '
                         f'1 to {MAX_PIXELS} pixels')
    return K, (height, width)


def image_fields(image: np.ndarray | None, stamp: Stamp | int, frame_id: str) -> dict[str, Any]:
    """
    Return the fields of a sensor_msgs/Image with a picture.

    :param image: uint8 (H, W, 3) rgb; None: no picture, which takes back the one before.
    :param stamp: the moment of the snapshot, a Stamp or ns.
    :param frame_id: frame of the camera.
    :raises ImageError: for another type or shape.
    """
    if image is None:
        image = np.zeros((0, 0, 3), np.uint8)
    else:
        check_image(image, 'image')
    return _fields(image, PICTURE_ENCODING, stamp, frame_id)


def jpeg_fields(image: np.ndarray, stamp: Stamp | int, frame_id: str) -> dict[str, Any]:
    """Return the fields of a sensor_msgs/CompressedImage; colours halved, as videos have them."""
    import cv2  # here, as in encodings.py
    check_image(image, 'image')
    data = cv2.imencode('.jpg', cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [
        cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return {'header': header_fields(stamp, frame_id), 'format': 'rgb8; jpeg compressed bgr8',
            'data': data}


def map_fields(values: np.ndarray, stamp: Stamp | int, frame_id: str,
               encoding: str = MAP_ENCODING) -> dict[str, Any]:
    """Return the fields of a sensor_msgs/Image with an object map, (H, W); else as above."""
    if encoding == 'mono8':
        grey = np.rint(values * (255 / max(float(values.max()), 1e-30))).astype(np.uint8)
        return _fields(grey, encoding, stamp, frame_id)
    return _fields(np.asarray(values, np.float32), MAP_ENCODING, stamp, frame_id)


def mask_fields(mask: np.ndarray | None, stamp: Stamp | int, frame_id: str) -> dict[str, Any]:
    """Return the fields of a sensor_msgs/Image with a robot mask, uint8 (H, W); else as above."""
    return _fields(
        np.zeros((0, 0), np.uint8) if mask is None else mask, MASK_ENCODING, stamp, frame_id)


def camera_info_fields(K: np.ndarray, size: Sequence[int], stamp: Stamp | int,
                       frame_id: str) -> dict[str, Any]:
    """
    Return the fields of the sensor_msgs/CameraInfo of a pinhole camera without distortion.

    :param K: (3, 3) intrinsics in pixels.
    :param size: (height, width) of its pictures.
    :param stamp: of the picture, a Stamp or ns.
    :param frame_id: frame of the camera.
    """
    return {
        'header': header_fields(stamp, frame_id), 'height': size[0], 'width': size[1],
        'distortion_model': 'plumb_bob', 'd': [0.0] * 5, 'k': np.ravel(K).astype(float).tolist(),
        'r': np.eye(3).ravel().tolist(),
        'p': np.column_stack([K, np.zeros(3)]).ravel().astype(float).tolist()}


def _fields(values: np.ndarray, encoding: str, stamp: Stamp | int,
            frame_id: str) -> dict[str, Any]:
    """Return the fields of a sensor_msgs/Image, rows not padded."""
    values = np.ascontiguousarray(values)
    height, width = values.shape[:2]
    return {
        'header': header_fields(stamp, frame_id), 'height': height, 'width': width,
        'encoding': encoding, 'is_bigendian': int(sys.byteorder == 'big'),
        'step': math.prod(values.shape[1:]) * values.itemsize,
        'data': values.reshape(-1).view(np.uint8)}


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Put a name in front of the errors that are raised within."""
    try:
        yield
    except ImageError as error:
        if not name:
            raise
        raise ImageError(f'{name}: {error}') from error


def _check_kind(message: Any, encoding: str, size: Sequence[int] | None, like: str = '') -> None:
    """Raise ImageError for another encoding, or another size where one is wanted."""
    if message.encoding != encoding:
        raise ImageError(f"encoding '{escaped(message.encoding, 40)}' cannot be used; valid "
                         f'encodings: {encoding}')
    if size is not None and (message.height, message.width) != tuple(size):
        raise ImageError(f'expected {size[1]}x{size[0]} pixels (width x height){like}, '
                         f'got {message.width}x{message.height}')


def _rows(message: Any, bytes_per_pixel: int, planes: float = 1) -> np.ndarray:
    """Check the layout; return uint8 (rows, width * bytes_per_pixel) without padding."""
    height, width, step = message.height, message.width, message.step
    _check_length(message)
    if height == 0 or width == 0:
        raise ImageError(f'is empty ({width}x{height} pixels); send a whole image')
    row_bytes = width * bytes_per_pixel
    step = step or row_bytes  # of drivers that leave it out
    if step < row_bytes:
        raise ImageError(
            f'step is {step} bytes, but {width} pixels of {message.encoding} take {row_bytes}; '
            'step must be at least that')
    rows = int(height * planes)
    if len(message.data) == step * height and height % int(2 * planes) == 0:
        rows = height  # some drivers count all rows of planes
    if len(message.data) != step * rows:
        raise ImageError(
            f'data has {len(message.data)} bytes, expected step * height = '
            f'{step} * {rows} = {step * rows}')
    return np.frombuffer(message.data, np.uint8).reshape(rows, step)[:, :row_bytes]


def _check_length(message: Any) -> None:
    """Raise ImageError for a message that is longer than any of use."""
    if len(message.data) > MAX_PICTURE_BYTES:
        raise ImageError(f'data has {len(message.data)} bytes; at most {MAX_PICTURE_BYTES} are '
                         'taken, send a smaller picture')
    if len(message.header.frame_id) > MAX_FRAME_ID:
        raise ImageError(f'frame_id has {len(message.header.frame_id)} characters; at most '
                         f'{MAX_FRAME_ID} are taken')
