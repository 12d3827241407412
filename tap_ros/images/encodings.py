# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Encodings of cameras to rgb: those of sensor_msgs/Image, and files in sensor_msgs/CompressedImage.

A new encoding is a row of ENCODINGS; recordings and nodes read it then.
"""

from contextlib import suppress
import io
import re
import struct
from typing import NamedTuple

import numpy as np
from tap_ros.base.contract import MAX_PICTURE_BYTES
from tap_ros.base.errors import ImageError
from tap_ros.base.text import escaped


class Encoding(NamedTuple):
    """
    How the pixels of an encoding become rgb.

    :param code: of cv2.cvtColor, without COLOR_; '': they are rgb.
    :param pixel_bytes: bytes of a pixel.
    :param block: (height, width) in pixels; a picture has whole blocks.
    :param least: pixels that a side has at least.
    :param planes: rows of data for each row of pixels, as colours may stand behind the greys.
    """

    code: str
    pixel_bytes: int = 3
    block: tuple[int, int] = (1, 1)
    least: int = 1
    planes: float = 1


_GREY, _UYVY, _YUYV = Encoding('GRAY2RGB', 1), *(
    Encoding(f'YUV2RGB_{code}', 2, (1, 2)) for code in ('UYVY', 'YUY2'))
ENCODINGS = {
    'rgb8': Encoding(''), 'bgr8': Encoding('BGR2RGB'), 'rgba8': Encoding('RGBA2RGB', 4),
    'bgra8': Encoding('BGRA2RGB', 4), 'mono8': _GREY,
    # What cv_bridge calls pictures of OpenCV, whose order is blue, green, red.
    '8UC1': _GREY, '8UC3': Encoding('BGR2RGB'), '8UC4': Encoding('BGRA2RGB', 4),
    'yuv422': _UYVY, 'uyvy': _UYVY, 'yuv422_yuy2': _YUYV, 'yuyv': _YUYV,
    **{name: Encoding(f'YUV2RGB_{name.upper()}', 1, (2, 2), planes=1.5)
       for name in ('nv12', 'nv21', 'i420')},
    # cv2 calls a mosaic by the second and third pixel of its second row.
    **{f'bayer_{name}8': Encoding(f'Bayer{code}2RGB', 1, (2, 2), 4) for name, code in (
        ('rggb', 'BG'), ('bggr', 'RG'), ('gbrg', 'GR'), ('grbg', 'GB'))}}
_DEEP = re.compile(r'(mono|rgb|bgr|rgba|bgra|bayer_[rgb]{4})16|(16|32|64)[US FC]+\d*')
_COMPRESSED = ('JPEG', 'PNG', 'WEBP', 'AVIF', 'JPEG2000')
_MARKER = re.compile(rb'\xff[^\0\xff\xd0-\xd7]')  # what ends the data of a JPEG's scan
_PADDING = 9  # bytes: the last one of a JPEG's data, and eight that cameras may put behind it


def find_encoding(name: str) -> Encoding:
    """
    Return the Encoding of this name, as in sensor_msgs/Image.

    :raises ImageError: for one that cannot be read; it says why.
    """
    if name in ENCODINGS:
        return ENCODINGS[name]
    why = ('it has more than 8 bits a channel, as depth cameras have; record the colour camera, '
           'or let its driver send 8 bits' if _DEEP.fullmatch(name) else
           f'valid encodings: {", ".join(ENCODINGS)}; let the driver send one of them')
    raise ImageError(f"encoding '{escaped(name, 40)}' cannot be used; {why}")


def to_rgb(pixels: np.ndarray, name: str) -> np.ndarray:
    """
    Turn raw pixels into a picture.

    :param pixels: uint8 (H * planes, W, pixel_bytes of the encoding).
    :param name: one of ENCODINGS.
    :return: uint8 (H, W, 3) rgb, contiguous.
    :raises ImageError: for a size that the encoding does not allow.
    """
    encoding, (rows, width) = ENCODINGS[name], pixels.shape[:2]
    height = int(rows / encoding.planes)
    if (height % encoding.block[0] or width % encoding.block[1]
            or min(height, width) < encoding.least):
        raise ImageError(f'{width}x{height} pixels of encoding {name}; it comes in blocks of '
                         'two')
    pixels = np.ascontiguousarray(pixels)
    if not encoding.code:
        return pixels
    import cv2  # here, as --help of training does without
    return np.asarray(cv2.cvtColor(pixels, getattr(cv2, f'COLOR_{encoding.code}')))


def decompress(data: bytes | memoryview | np.ndarray, description: str,
               most: int = MAX_PICTURE_BYTES) -> np.ndarray:
    """
    Decode a compressed picture.

    :param data: of sensor_msgs/CompressedImage: a file of one of _COMPRESSED.
    :param description: its field `format`, such as 'rgb8; jpeg compressed bgr8'.
    :param most: bytes of rgb.
    :return: uint8 (H, W, 3) rgb, turned upright as its EXIF data say.
    :raises ImageError: for another format, more than 8 bits a channel, damage, or too many pixels.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError
    if 'compresseddepth' in description.lower():
        raise ImageError('a compressed depth picture, which shows no colours; record the colour '
                         'camera')
    stream = _Parts(bytes(data))
    try:
        with Image.open(stream, formats=_COMPRESSED) as file:
            width, height = file.size
            if width * height * 3 > most:
                raise ImageError(f'{width}x{height} pixels are more than {most} bytes '
                                 'of rgb; send a smaller picture')
            encoding = description.split(';')[0].strip()
            raw = file.tile[0][3] if file.tile else ''  # such as RGB;16B
            if file.mode[:1] in 'IF' or (isinstance(raw, str) and ';16' in raw):
                raise ImageError('a compressed picture with more than 8 bits a channel; send 8')
            if file.format == 'JPEG':
                stream.divide('progressive' in file.info)
            file.load()
            if stream.left:
                raise OSError('some of its data are missing or altered')
            if file.mode == 'L' and encoding.startswith('bayer_') and encoding in ENCODINGS:
                return to_rgb(np.array(file)[..., None], encoding)  # the raw mosaic
            picture = file if file.mode == 'RGB' else file.convert('RGB')
            with suppress(struct.error, SyntaxError, TypeError, ValueError):  # broken EXIF data
                ImageOps.exif_transpose(picture, in_place=True)
            return np.array(picture)
    except UnidentifiedImageError:
        raise ImageError(
            f"no picture, or a damaged one: '{escaped(description, 40)}'; valid are JPEG, PNG, "
            'WebP, AVIF and JPEG 2000') from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ImageError(f'damaged compressed picture: {escaped(error, 80)}') from error


class _Parts(io.BytesIO):
    """
    A JPEG file that Pillow is given in two parts, which shows whether it is whole.

    libjpeg fills in what is damaged, and warns where Pillow does not listen. But it needs all
    data of a good picture for its last row: one that is done before the end holds too much, one
    that is not done there too little. Marks behind, also that of the end, need not be there.

    :param data: of the file.
    :ivar left: parts that were not asked for.
    """

    left: list[bytes] | None = None

    def divide(self, progressive: bool) -> None:
        """
        Give what is read from now on in parts; the header has been read.

        :raises OSError: when there are other bytes among its segments.
        """
        data, scan, at = self.getvalue(), self.tell(), 2
        while at < scan and data[at] == 0xff:  # one segment after the other, or filled up
            at += 1 if data[at + 1] == 0xff else 2 + int.from_bytes(data[at + 2:at + 4])
        if at != scan:
            raise OSError('its header is damaged')
        found = _MARKER.search(data, scan)
        end = found.start() if found else len(data)
        kept = max(scan, len(data[:end].rstrip(b'\0\xff')) - _PADDING)
        self.left = [data[kept:end] + bytes(16), data[:kept]]
        if progressive or b'\xff\xda' in data[scan:]:  # rows come when all scans are read
            self.left = [data + b'\xff\xd9']

    def read(self, size: int | None = -1) -> bytes:
        """Return the next part."""
        if self.left is None:
            return super().read(size)
        return self.left.pop() if self.left else b''
