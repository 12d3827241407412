# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The one place that knows pixel conventions.

Inside the networks: NCHW float32 in [-1, 1]. Outside: HWC uint8, rgb8.
A pixel position is (u, v) = (column, row) with (0, 0) at the centre of the top-left pixel.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import ImageError

if TYPE_CHECKING:
    import torch

_IS_MASK_VALUE = np.isin(np.arange(256), (ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM))


def to_float(images: 'np.ndarray | torch.Tensor') -> 'torch.Tensor':
    """
    Turn pictures into network inputs.

    :param images: uint8 (..., H, W, 3), numpy array or tensor.
    :return: float32 tensor (..., 3, H, W) in [-1, 1].
    """
    if isinstance(images, np.ndarray):
        import torch  # here, since it takes seconds, and nodes without a network need no tensors
        # Recorded frames are read-only memory maps, which torch warns about unless copied.
        images = torch.from_numpy(np.require(images, requirements=['C', 'W']))
    return images.movedim(-1, -3).float().div_(127.5).sub_(1.0)


def to_uint8(images: 'torch.Tensor') -> np.ndarray:
    """
    Turn network outputs into pictures, rounding to the nearest value.

    :param images: tensor (..., 3, H, W) in [-1, 1]; values beyond are clipped.
    :return: uint8 numpy array (..., H, W, 3).
    """
    pixels = images.detach().float().add(1.0).mul(127.5).round_().clamp_(0, 255)
    return pixels.byte().movedim(-3, -1).contiguous().cpu().numpy()


def check_image(image: object, name: str, size: Sequence[int] | None = None) -> np.ndarray:
    """
    Accept a picture or say what is wrong with it.

    :param image: what should be a uint8 array (H, W, 3).
    :param name: how the message calls it, for example 'goal'.
    :param size: the only (height, width) accepted, or None for any.
    :return: the same array.
    :raises ImageError: for another type, shape or size.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        kind = getattr(image, 'dtype', type(image).__name__)
        raise ImageError(f'{name}: expected a uint8 array of rgb pixels, got {kind}')
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ImageError(f'{name}: expected shape (height, width, 3), got {image.shape}')
    if size is not None and image.shape[:2] != tuple(size):
        raise ImageError(
            f'{name}: expected {size[1]}x{size[0]} pixels (width x height), '
            f'got {image.shape[1]}x{image.shape[0]}; cut and scale it '
            'to that, or use weights for its size')
    return image


def check_mask(mask: np.ndarray) -> np.ndarray:
    """
    Return a robot mask if all its values are those of one.

    :param mask: uint8, any shape.
    :raises ImageError: for another value.
    """
    right = _IS_MASK_VALUE[mask]
    if not right.all():
        raise ImageError(
            f'a robot mask with the value {mask[~right][0]}; expected {ROBOT_MASK_FREE} (free), '
            f'{ROBOT_MASK_HAND} (hand) or {ROBOT_MASK_ARM} (arm)')
    return mask


def check_pixels(pixels: ArrayLike | None, name: str) -> np.ndarray:
    """
    Accept object positions or say what is wrong with them.

    :param pixels: (K, 2) numbers in (u, v) order, or None for no objects.
    :param name: how the message calls them.
    :return: float32 (K, 2).
    :raises ImageError: for another shape, or positions that are not finite.
    """
    if pixels is None or np.size(pixels) == 0:
        return np.zeros((0, 2), np.float32)
    pixels = np.asarray(pixels, np.float32)
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ImageError(f'{name}: expected shape (objects, 2), got {pixels.shape}')
    unknown = np.flatnonzero(~np.isfinite(pixels).all(1)).tolist()
    if unknown:
        raise ImageError(f'{name}: unknown (not finite) for objects {unknown}; give (u, v) in '
                         'pixels for every object, or leave those out')
    return np.ascontiguousarray(pixels)  # torch takes no flipped views


def in_picture(pixels: np.ndarray, size: Sequence[int]) -> np.ndarray | np.bool_:
    """
    Tell which positions are in a picture; it reaches half a pixel beyond the outermost centres.

    :param pixels: (..., 2) as (u, v).
    :param size: (height, width).
    :return: bool (...); False where a position is not a number.
    """
    return ((pixels >= -0.5) & (pixels <= np.array(size[::-1]) - 0.5)).all(-1)


def resize_image(image: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """
    Resize a picture with antialiasing.

    :param image: uint8 (H, W, 3).
    :param size: (height, width) of the answer.
    :return: uint8 (height, width, 3).
    """
    import torch  # as above
    planes = torch.from_numpy(image.astype(np.float32, order='C')).movedim(-1, 0)[None]
    planes = torch.nn.functional.interpolate(
        planes, tuple(size), mode='bilinear', antialias=True, align_corners=False)
    return planes[0].round().clamp(0, 255).byte().movedim(0, -1).contiguous().numpy()


def resize_pixels(pixels: np.ndarray, old_size: Sequence[int],
                  new_size: Sequence[int]) -> np.ndarray:
    """
    Move pixel positions along with a resized picture.

    :param pixels: (..., 2) as (u, v); (0, 0) is the centre of the top-left pixel.
    :param old_size: (height, width) of the picture they belong to.
    :param new_size: (height, width) after resizing.
    :return: float32 (..., 2).
    """
    scale = np.array([new_size[1] / old_size[1], new_size[0] / old_size[0]])
    # in float64, so that pixels of the same size stay the same to the last bit
    return ((np.asarray(pixels, np.float64) + 0.5) * scale - 0.5).astype(np.float32)
