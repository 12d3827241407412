# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pixels of cameras in whatever encoding to rgb: of sensor_msgs/Image and of CompressedImage."""

import io
import re

import numpy as np
from tap_ros.contract import ENCODINGS, MAX_PICTURE_BYTES
from tap_ros.errors import ImageError
from tap_ros.text import escaped

# Names of cv2, which is imported late: --help of training comes without.
_YUV = {'yuv422': 'COLOR_YUV2RGB_UYVY', 'uyvy': 'COLOR_YUV2RGB_UYVY',
        'yuv422_yuy2': 'COLOR_YUV2RGB_YUY2', 'yuyv': 'COLOR_YUV2RGB_YUY2'}
# It calls patterns by the second and third pixel of the second row.
_BAYER = {'bayer_rggb8': 'COLOR_BayerBG2RGB', 'bayer_bggr8': 'COLOR_BayerRG2RGB',
          'bayer_gbrg8': 'COLOR_BayerGR2RGB', 'bayer_grbg8': 'COLOR_BayerGB2RGB'}
READABLE = (*ENCODINGS, *_YUV, *_BAYER)
_DEEP = re.compile(r'(mono|rgb|bgr|rgba|bgra|bayer_[rgb]{4})16|(16|32|64)[US FC]+\d*')
_COMPRESSED = ('JPEG', 'PNG', 'WEBP')


def pixel_bytes(encoding: str) -> int:
    """
    Return the bytes of a pixel.

    :param encoding: of sensor_msgs/Image.
    :raises ImageError: for one that cannot be read; it says why.
    """
    if encoding in ENCODINGS:
        return ENCODINGS[encoding][0]
    if encoding in _YUV:
        return 2
    if encoding in _BAYER:
        return 1
    why = ''
    if _DEEP.fullmatch(encoding):
        why = (' (it has more than 8 bits a channel, as depth cameras have; record the colour '
               'camera, or let its driver send 8 bits)')
    raise ImageError(f"encoding '{escaped(encoding, 40)}' cannot be used{why}; valid encodings: "
                     f'{", ".join(READABLE)}')


def to_rgb(pixels: np.ndarray, encoding: str) -> np.ndarray:
    """
    Turn raw pixels into a picture.

    :param pixels: uint8 (H, W, pixel_bytes(encoding)).
    :param encoding: one of READABLE.
    :return: uint8 (H, W, 3) rgb, contiguous.
    :raises ImageError: for a size that the encoding does not allow.
    """
    if encoding in ENCODINGS:
        channels, order = ENCODINGS[encoding]
        if order != tuple(range(channels)):
            pixels = pixels[..., list(order)]
        return np.ascontiguousarray(pixels)
    height, width = pixels.shape[:2]
    if width % 2 or (encoding in _BAYER and (height % 2 or min(height, width) < 4)):
        raise ImageError(f'{width}x{height} pixels of encoding {encoding}; it comes in blocks of '
                         'two')
    import cv2
    pixels = np.ascontiguousarray(pixels)
    if encoding in _YUV:
        return cv2.cvtColor(pixels, getattr(cv2, _YUV[encoding]))
    return cv2.demosaicing(pixels[..., 0], getattr(cv2, _BAYER[encoding]))


def decompress(data: bytes | memoryview | np.ndarray, description: str) -> np.ndarray:
    """
    Decode a compressed picture.

    :param data: of sensor_msgs/CompressedImage: a JPEG, PNG or WebP file.
    :param description: its field `format`, such as 'rgb8; jpeg compressed bgr8'.
    :return: uint8 (H, W, 3) rgb.
    :raises ImageError: for another format, more than 8 bits a channel, damage, or too many pixels.
    """
    from PIL import Image, UnidentifiedImageError
    if 'compresseddepth' in description.lower():
        raise ImageError('a compressed depth picture; name the topic of the colour camera')
    try:
        with Image.open(io.BytesIO(bytes(data)), formats=_COMPRESSED) as file:
            width, height = file.size
            if width * height * 3 > MAX_PICTURE_BYTES:
                raise ImageError(f'{width}x{height} pixels are more than {MAX_PICTURE_BYTES} '
                                 'bytes of rgb; send a smaller picture')
            encoding = description.split(';')[0].strip()
            if file.mode == 'L' and encoding in _BAYER:  # the raw mosaic
                return to_rgb(np.array(file)[..., None], encoding)
            raw = file.tile[0][3] if file.tile else ''  # such as RGB;16B
            if file.mode[:1] in 'IF' or (isinstance(raw, str) and ';16' in raw):
                raise ImageError('a compressed picture with more than 8 bits a channel; send 8')
            return np.array(file.convert('RGB'))
    except UnidentifiedImageError:
        raise ImageError(
            f"format '{escaped(description, 40)}' cannot be used; valid are JPEG, PNG and WebP"
        ) from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ImageError(f'damaged compressed picture: {escaped(error, 80)}') from error
