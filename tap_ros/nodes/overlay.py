# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A picture for people: where each object is to go."""

import numpy as np

SCALE = 4  # pixels of the overlay per pixel of the picture
MARK_REACH = 12  # pixels of the overlay that a mark needs on each side
COLOURS = np.array([
    [230, 60, 40], [40, 110, 240], [250, 190, 30], [40, 190, 120], [180, 80, 220], [30, 200, 220]])


def draw_overlay(start, object_maps, start_pixels, goal_pixels):
    """
    Paint object maps, starts and goals over the start picture.

    A coloured cloud is the map of an object, a ring its start, a cross its goal.

    :param start: uint8 (H, W, 3).
    :param object_maps: (K, H, W), each sums to 1.
    :param start_pixels: (K, 2) as (u, v), or None.
    :param goal_pixels: (K, 2) as (u, v), or None.
    :return: uint8 (SCALE * H, SCALE * W, 3).
    """
    picture = start.astype(np.float32)
    for index, object_map in enumerate(object_maps):
        # The root makes a wide, faint map visible beside a sharp one.
        strength = 0.85 * np.sqrt(object_map / max(object_map.max(), 1e-12))[..., None]
        picture += strength * (COLOURS[index % len(COLOURS)] - picture)
    picture = picture.round().clip(0, 255).astype(np.uint8)
    picture = picture.repeat(SCALE, axis=0).repeat(SCALE, axis=1)
    for pixels, shape in ((start_pixels, ring), (goal_pixels, cross)):
        for index, pixel in enumerate([] if pixels is None else pixels):
            draw_mark(picture, pixel, shape, COLOURS[index % len(COLOURS)])
    return picture


def draw_mark(picture, pixel, shape, colour):
    """Draw a mark with a white edge around a pixel (u, v) of the small picture, in place."""
    u, v = (np.asarray(pixel, float) + 0.5) * SCALE - 0.5
    left, top = max(int(u) - MARK_REACH, 0), max(int(v) - MARK_REACH, 0)
    patch = picture[top:max(int(v) + MARK_REACH, 0), left:max(int(u) + MARK_REACH, 0)]
    down, across = np.mgrid[:patch.shape[0], :patch.shape[1]].astype(float)
    down += top - v
    across += left - u
    patch[shape(across, down, 3.5)] = 255
    patch[shape(across, down, 2.0)] = colour


def ring(across, down, thickness):
    """Tell which offsets from the centre belong to a ring."""
    return np.abs(np.hypot(across, down) - 8) < thickness / 2


def cross(across, down, thickness):
    """Tell which offsets from the centre belong to an upright cross."""
    across, down = np.abs(across), np.abs(down)
    reach = 7 + thickness / 2
    return (np.minimum(across, down) < thickness / 2) & (np.maximum(across, down) < reach)
