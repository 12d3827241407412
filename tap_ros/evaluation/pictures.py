# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures for people: object maps over a frame, film strips, PNG bytes."""

import cv2
import numpy as np

OBJECT_COLOURS = (  # rgb, one per object, told apart by colour-blind readers too
    (255, 176, 0), (100, 143, 255), (220, 38, 127), (0, 158, 115))


def enlarge(image, scale):
    """
    Make a picture larger without blurring it.

    :param image: (H, W, 3) or (H, W).
    :param scale: whole number.
    :return: the same with every pixel scale x scale times.
    """
    return np.repeat(np.repeat(image, scale, axis=0), scale, axis=1)


def overlay_maps(image, object_maps, scale=4, start_pixels=None, goal_pixels=None):
    """
    Paint the probability maps of the objects over a picture.

    :param image: uint8 (H, W, 3) rgb.
    :param object_maps: (K, H, W), each sums to 1; painted relative to its own highest value.
    :param scale: enlargement of the answer.
    :param start_pixels: (K, 2) (u, v) marked by a hollow circle, or None.
    :param goal_pixels: (K, 2) (u, v) marked by a cross, or None.
    :return: uint8 (H * scale, W * scale, 3).
    """
    canvas = enlarge(image, scale).astype(np.float32)
    for k, object_map in enumerate(object_maps):
        colour = np.array(OBJECT_COLOURS[k % len(OBJECT_COLOURS)], np.float32)
        share = enlarge(object_map / max(object_map.max(), 1e-9), scale)[..., None]
        canvas += 0.8 * share * (colour - canvas)
    canvas = np.ascontiguousarray(canvas.round().astype(np.uint8))
    for pixels, draw in ((start_pixels, _circle), (goal_pixels, _cross)):
        for k, pixel in enumerate(() if pixels is None else pixels):
            if np.isfinite(pixel).all():
                centre = tuple(int((x + 0.5) * scale) for x in pixel)
                draw(canvas, centre, scale, OBJECT_COLOURS[k % len(OBJECT_COLOURS)])
    return canvas


def _circle(canvas, centre, scale, colour):
    cv2.circle(canvas, centre, 2 * scale, colour, max(scale // 3, 1), cv2.LINE_AA)


def _cross(canvas, centre, scale, colour):
    cv2.drawMarker(
        canvas, centre, colour, cv2.MARKER_TILTED_CROSS, 3 * scale, max(scale // 3, 1),
        cv2.LINE_AA)


def film_strip(frames, count=10, scale=2):
    """
    Put evenly spaced frames side by side.

    :param frames: (T, H, W, 3) uint8 or a list of (H, W, 3).
    :param count: how many; the first and the last are always among them.
    :param scale: enlargement.
    :return: uint8 (H * scale, count * W * scale, 3).
    """
    chosen = np.linspace(0, len(frames) - 1, count).round().astype(int)
    return np.hstack([enlarge(np.asarray(frames[i]), scale) for i in chosen])


def png_bytes(image):
    """
    Encode a picture.

    :param image: uint8 (H, W, 3) rgb or (H, W).
    :return: bytes of a PNG file.
    """
    image = image[..., ::-1] if image.ndim == 3 else image
    return cv2.imencode('.png', np.ascontiguousarray(image))[1].tobytes()
