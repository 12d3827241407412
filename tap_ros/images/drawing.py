# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures for people: object maps over a frame, panels side by side, film strips."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from tap_ros.images.pixels import to_uint8

if TYPE_CHECKING:
    import torch

OBJECT_COLOURS = (  # rgb, one per object; colour-blind readers tell them apart too
    (255, 176, 0), (100, 143, 255), (220, 38, 127), (0, 158, 115))
GAP = 2  # white pixels between panels
MARGIN = 8  # pixels outside a picture from where no mark reaches into it
LARGEST = 1280  # px; larger pictures are made smaller for a page
LOSSLESS = 256  # px; larger ones are sent as JPEG
HALO_STD, HALO = 1.3, 0.6  # pixels, and strength, of the glow around a map: sharp ones are tiny


def enlarge(image: np.ndarray, scale: int) -> np.ndarray:
    """
    Make a picture larger without blurring it.

    :param image: (H, W, ...).
    :param scale: whole number of times to enlarge each pixel.
    :return: (H * scale, W * scale, ...).
    """
    return image.repeat(scale, axis=0).repeat(scale, axis=1)


def overlay(image: np.ndarray, object_maps: Iterable[np.ndarray], scale: int = 1,
            start_pixels: np.ndarray | None = None,
            goal_pixels: np.ndarray | None = None) -> np.ndarray:
    """
    Tint a picture where objects are expected.

    :param image: uint8 (H, W, 3) rgb.
    :param object_maps: (K, h, w), each sums to 1; smaller ones than the picture are enlarged.
    :param scale: whole number of times to enlarge the picture.
    :param start_pixels: (K, 2) (u, v) marked by a circle, or None.
    :param goal_pixels: (K, 2) (u, v) marked by a cross, or None.
    :return: uint8 (H * scale, W * scale, 3).
    """
    tinted, size, unit = image.astype(np.float32), image.shape[1::-1], scale
    for k, probability in enumerate(object_maps):
        # The square root makes spread-out maps visible beside sharp ones.
        share = np.asarray(probability / max(probability.max(), 1e-12), np.float32)
        glow = cv2.GaussianBlur(share, (7, 7), HALO_STD, borderType=cv2.BORDER_CONSTANT)
        glow = HALO * glow / max(float(glow.max()), 1e-12)
        strength = np.maximum(0.9 * np.sqrt(share), glow)
        if strength.shape[::-1] != size:
            unit = scale * max(1, size[0] // strength.shape[1])  # of marks: a pixel of the maps
            strength = np.asarray(cv2.resize(strength, size, interpolation=cv2.INTER_LINEAR))
        colour = np.array(OBJECT_COLOURS[k % len(OBJECT_COLOURS)], np.float32)
        tinted += strength[..., None] * (colour - tinted)
    canvas = enlarge(np.rint(tinted).astype(np.uint8), scale)
    for centre, colour in _marks(canvas, start_pixels, scale):
        cv2.circle(canvas, centre, 3 * unit, colour, max(unit // 3, 1), cv2.LINE_AA)
    draw_crosses(canvas, goal_pixels, scale, unit=unit)
    return canvas


def draw_crosses(canvas: np.ndarray, pixels: np.ndarray | None, scale: int,
                 edge: tuple[int, int, int] | None = None, unit: int = 0) -> None:
    """
    Draw a cross in the colour of each object into an enlarged picture.

    :param canvas: uint8 (H * scale, W * scale, 3) rgb.
    :param pixels: (K, 2) (u, v) before it was enlarged, or None; those not finite are left out.
    :param scale: how many times it was enlarged.
    :param edge: (r, g, b) around the crosses, or None.
    :param unit: pixels, a quarter of a cross; 0: the scale.
    """
    unit = unit or scale
    width = max(unit // 3, 1)
    for centre, colour in _marks(canvas, pixels, scale):
        for shade, wide in ((edge, 3 * width), (colour, width)):
            if shade is not None:
                cv2.drawMarker(canvas, centre, shade, cv2.MARKER_TILTED_CROSS, 4 * unit, wide,
                               cv2.LINE_AA)


def _marks(canvas: np.ndarray, pixels: np.ndarray | None,
           scale: int) -> Iterator[tuple[tuple[int, int], tuple[int, int, int]]]:
    """Yield where the mark of each object is in an enlarged picture, and its colour."""
    size = canvas.shape[1] // scale, canvas.shape[0] // scale
    for k, pixel in enumerate(() if pixels is None else pixels):
        if np.isfinite(pixel).all():
            # Far outside, where no mark is seen, numbers may be too large to draw.
            near = (min(max(x, -MARGIN), limit + MARGIN) for x, limit in zip(pixel, size))
            u, v = (int((x + 0.5) * scale) for x in near)
            yield (u, v), OBJECT_COLOURS[k % len(OBJECT_COLOURS)]


def grid(rows: Sequence[Sequence[np.ndarray]], scale: int = 1) -> np.ndarray:
    """
    Put panels of one size side by side, and rows below each other.

    :param rows: list of lists of uint8 (H, W, 3).
    :param scale: whole number of times to enlarge each pixel.
    :return: uint8 (height, width, 3), white between the panels.
    """
    rows = [[enlarge(np.asarray(panel), scale) for panel in row] for row in rows]
    H, W, _ = rows[0][0].shape
    columns = max(len(row) for row in rows)
    sheet = np.full((len(rows) * (H + GAP) - GAP, columns * (W + GAP) - GAP, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, panel in enumerate(row):
            sheet[i * (H + GAP):i * (H + GAP) + H, j * (W + GAP):j * (W + GAP) + W] = panel
    return sheet


def film_strip(frames: Sequence[np.ndarray] | np.ndarray, count: int = 10) -> list[np.ndarray]:
    """
    Choose evenly spaced frames, the first and the last among them.

    :param frames: (T, H, W, 3) uint8 or a list of (H, W, 3).
    :param count: how many.
    :return: list of `count` frames, a row for grid.
    """
    chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return [frames[i] for i in chosen]


def png_bytes(image: np.ndarray) -> bytes:
    """
    Encode a picture.

    :param image: uint8 (H, W, 3) rgb.
    :return: bytes of a PNG file.
    """
    return cv2.imencode('.png', np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def picture_bytes(image: np.ndarray, lossless: bool = False) -> bytes:
    """Encode a picture for a page, a large one made smaller; PNG where it is small or lossless."""
    height, width = image.shape[:2]
    share = LARGEST / max(width, height)
    if share < 1:
        size = [max(1, round(share * side)) for side in (width, height)]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if lossless or max(width, height) <= LOSSLESS:
        return png_bytes(image)
    return cv2.imencode('.jpg', np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def grey_panels(maps: 'torch.Tensor') -> list[np.ndarray]:
    """
    Show numbers from 0 to 1 as grey.

    :param maps: tensor (N, H, W).
    :return: list of N uint8 (H, W, 3).
    """
    return list(to_uint8(maps[:, None].expand(-1, 3, -1, -1) * 2 - 1))
