# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which part of a camera's pictures networks see, and at what size.

The same cut is made where recordings are decoded and where pictures stream in, so that a network
is asked about pictures like those it was trained on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import re
from typing import Any

import numpy as np
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import ConfigError, ImageError
from tap_ros.base.text import escaped
from tap_ros.images.pixels import resize_image, resize_pixels

CENTRE, WHOLE = 'centre', 'whole'
MAX_SIZE = 4096  # px, of a side


@dataclass(frozen=True)
class Crop:
    """
    A square part of pictures, scaled; by default pictures stay as they are.

    :param part: 'centre': the largest square in the middle; 'LEFT,TOP,SIDE': that square, in
        pixels of the camera; 'whole': all of it, which size squeezes into a square; '': all of
        it, which has to be square if it is scaled.
    :param size: pixels a side after scaling; 0: not scaled.
    :raises ConfigError: for another part, or a size that no picture has.
    """

    part: str = ''
    size: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be cut."""
        if self.part not in ('', CENTRE, WHOLE):
            numbers = re.fullmatch(r'(\d{1,5}),(\d{1,5}),([1-9]\d{0,4})', self.part)
            if numbers is None:
                raise ConfigError(
                    f'crop: expected {CENTRE}, {WHOLE}, or LEFT,TOP,SIDE of a square in pixels of '
                    f'the camera, such as 80,0,480; got {escaped(repr(self.part), 40)}')
        if not 0 <= self.size <= MAX_SIZE:
            raise ConfigError(f'size: expected 0 to {MAX_SIZE} pixels a side, got {self.size}')

    def __bool__(self) -> bool:
        """Return whether pictures are changed."""
        return bool(self.part or self.size)

    def window(self, size: Sequence[int]) -> tuple[int, int, int, int]:
        """
        Say which part of a picture is used.

        :param size: (height, width) of the picture.
        :return: left, top, width and height in pixels.
        :raises ImageError: when the picture does not hold it, or is not square where it has to be.
        """
        height, width = size
        if self.part == CENTRE:
            side = min(height, width)
            return (width - side) // 2, (height - side) // 2, side, side
        if self.part not in ('', WHOLE):
            left, top, side = map(int, self.part.split(','))
            if left + side > width or top + side > height:
                raise ImageError(f'crop {self.part} reaches beyond a picture of {width}x{height} '
                                 'pixels (width x height)')
            return left, top, side, side
        if self.size and height != width and self.part != WHOLE:
            raise ImageError(
                f'pictures of {width}x{height} pixels (width x height) are not square; training '
                f'says which part of them is used, by --crop {CENTRE}, {WHOLE} or LEFT,TOP,SIDE')
        return 0, 0, width, height

    def cut_size(self, size: Sequence[int]) -> tuple[int, int]:
        """Return (height, width) after cutting and scaling a picture of this size; see window."""
        _, _, width, height = self.window(size)
        return (self.size, self.size) if self.size else (height, width)

    def image(self, image: np.ndarray) -> np.ndarray:
        """
        Cut and scale a picture, with antialiasing.

        :param image: uint8 (H, W, 3).
        :return: uint8 (h, w, 3), contiguous.
        :raises ImageError: see window.
        """
        left, top, width, height = self.window(image.shape[:2])
        part, size = image[top:top + height, left:left + width], self.cut_size(image.shape[:2])
        return np.ascontiguousarray(part) if part.shape[:2] == size else resize_image(part, size)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """
        Cut and scale a robot mask: a pixel into which any masked pixel is mixed is masked.

        :param mask: uint8 (H, W), values as in contract.py.
        :return: uint8 (h, w).
        :raises ImageError: see window.
        """
        left, top, width, height = self.window(mask.shape)
        part, size = mask[top:top + height, left:left + width], self.cut_size(mask.shape)
        if part.shape == size:
            return np.ascontiguousarray(part)
        labels = np.stack([part != ROBOT_MASK_FREE, part == ROBOT_MASK_ARM], -1)
        hidden, arm = np.moveaxis(resize_image(
            np.uint8(255) * np.pad(labels, ((0, 0), (0, 0), (0, 1))), size)[..., :2] > 0, -1, 0)
        return np.where(arm, ROBOT_MASK_ARM, np.where(hidden, ROBOT_MASK_HAND, ROBOT_MASK_FREE)
                        ).astype(np.uint8)

    def pixels(self, pixels: np.ndarray, size: Sequence[int]) -> np.ndarray:
        """
        Move pixel positions along with the picture.

        :param pixels: (..., 2) as (u, v); (0, 0) is the centre of the top-left pixel.
        :param size: (height, width) of the picture they belong to.
        :return: (..., 2), of the same type; outside of the part they lie outside of the picture.
        :raises ImageError: see window.
        """
        left, top, width, height = self.window(size)
        new = self.cut_size(size)
        if (height, width) == new == tuple(size):
            return pixels
        moved = resize_pixels(
            np.asarray(pixels, np.float64) - (left, top), (height, width), new)
        return moved.astype(np.asarray(pixels).dtype)


def is_halved(side: int) -> bool:
    """Return whether a side can be halved until 4 or 6 pixels are left, and has 16 at least."""
    return side >= 16 and side // (side & -side) in (1, 3)


def check_trainable(size: Sequence[int], network: str) -> None:
    """
    Refuse recorded pictures that no network of ours takes.

    :param size: (height, width) after cutting.
    :param network: what errors call it.
    :raises ConfigError: unless they are square, and networks can halve a side, see is_halved.
    """
    height, width = size
    if height != width or not is_halved(width):
        raise ConfigError(
            f'recordings: pictures are {width}x{height} pixels; {network} needs square ones whose '
            'side is a power of two or three times one, from 16 on, such as 64 or 96; say which '
            'part is used and how large it becomes, for example --crop centre --size 64')


@dataclass(frozen=True)
class TrainedCrop:
    """
    What a network makes of pictures that stream in: the cut of its training.

    :param crop: Crop of the recordings.
    :param camera_size: (height, width) of the recorded pictures before it; None: they differed.
    :param size: (height, width) of the pictures that the network takes.
    """

    crop: Crop
    camera_size: tuple[int, int] | None
    size: tuple[int, int]

    def is_cut(self, size: Sequence[int]) -> bool:
        """
        Return whether a picture that is cut already can be of a size, scaled or not.

        :param size: its (height, width): not smaller than the network's, and of the shape of that,
            or of the camera's where all of the picture is squeezed into it.
        """
        shapes = [self.size]
        if self.crop.part == WHOLE and self.camera_size:
            shapes.append(self.camera_size)
        return (size[0] >= self.size[0] and size[1] >= self.size[1]
                and any(size[0] * width == size[1] * height for height, width in shapes))

    def of(self, size: Sequence[int], name: str) -> Crop:
        """
        Say how a picture is cut.

        :param size: its (height, width).
        :param name: how errors call it, for example 'goal'.
        :return: Crop; one that changes nothing for a picture that has the network's size already.
            What is cut already, but not scaled, is scaled; where the training cut nothing, these
            are all larger squares.
        :raises ImageError: when it is of another size and cannot be cut as in training.
        """
        given, (height, width) = tuple(size), self.size
        square = height == width and given[0] == given[1]
        if not self.crop and square and given[0] > height:
            return Crop(size=height)
        if square and self.camera_size not in (None, given) and given == (
                self.crop.window(self.camera_size)[3:1:-1]):
            return Crop(size=height)
        if not self.crop or (given == self.size and given != self.camera_size):
            return Crop()
        if given != self.camera_size and self.crop.part not in ('', CENTRE):
            camera = 'x'.join(map(str, reversed(self.camera_size or self.size)))
            raise ImageError(
                f'{name}: {given[1]}x{given[0]} pixels (width x height); the weights were trained '
                f'on the part {self.crop.part} of pictures of {camera}; send such ones, or '
                f'{self.size[1]}x{self.size[0]} pixels that are cut already')
        try:
            cut = self.crop.cut_size(given)
        except ImageError as error:
            raise ImageError(f'{name}: {error}') from error
        return self.crop if cut == self.size else Crop(self.crop.part, self.size[0])

    def unscaled(self, size: Sequence[int], name: str) -> Crop:
        """Say how a picture is cut, as `of`, but not made smaller."""
        cut = self.of(size, name)
        part = Crop(cut.part)
        return part if self.is_cut(part.cut_size(size)) else cut

    def unlike(self, size: Sequence[int], name: str) -> str:
        """Say that a picture's middle shows more or less than in training; '': it does not."""
        if (self.crop.part != CENTRE or self.camera_size is None or tuple(size) == self.size
                or size[0] * self.camera_size[1] == size[1] * self.camera_size[0]):
            return ''
        return ('{0}: the weights were trained on the middle of pictures of {4}x{3} (width x '
                'height); that of {2}x{1} may show another part of the scene'.format(
                    name, *size, *self.camera_size))


def trained_crop(training: Mapping[str, Any], size: tuple[int, int]) -> TrainedCrop:
    """
    Return the cut that weights were trained with.

    :param training: the training dict of a weights file, of any version.
    :param size: (height, width) that the network takes.
    :return: TrainedCrop; one that changes nothing where the file tells none.
    """
    settings = training.get('settings')
    settings = settings if isinstance(settings, dict) else {}
    part, side, camera = (
        settings.get('crop', ''), settings.get('size', 0), training.get('camera_size'))
    try:
        crop = Crop(part, side) if isinstance(part, str) and isinstance(side, int) else Crop()
    except ConfigError:
        crop = Crop()
    if isinstance(camera, list) and len(camera) == 2 and all(isinstance(n, int) for n in camera):
        return TrainedCrop(crop, (camera[0], camera[1]), size)
    return TrainedCrop(crop, None, size)
