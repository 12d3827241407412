# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the pictures for people."""

import numpy as np
from tap_ros.images.drawing import overlay

SCALE = 4


def test_the_overlay_shows_each_map_where_it_is():
    start = np.full((16, 16, 3), 128, np.uint8)
    maps = np.zeros((2, 16, 16))
    maps[0, 3, 12] = maps[1, 12, 3] = 1
    shown = overlay(start, maps, SCALE)
    assert shown.shape == (16 * SCALE, 16 * SCALE, 3)
    changed = (shown != 128).any(axis=-1).reshape(16, SCALE, 16, SCALE).any(axis=(1, 3))
    rows, columns = np.nonzero(changed)  # a glow around each, as one pixel is hardly seen
    near = np.minimum(np.hypot(rows - 3, columns - 12), np.hypot(rows - 12, columns - 3))
    assert near.max() < 5 and len(rows) > 20
    strength = np.abs(shown.astype(int) - 128).sum(-1)[::SCALE, ::SCALE]
    for row, column in ((3, 12), (12, 3)):
        around = strength[row - 3:row + 4, column - 3:column + 4]
        assert np.unravel_index(around.argmax(), around.shape) == (3, 3)
    marked = overlay(start, maps, SCALE, np.array([[8, 8], [2, 2]]), np.array([[4, 4], [9, 9]]))
    assert (marked != shown).any()


def test_maps_that_are_smaller_than_the_picture_are_shown_in_place():
    picture, maps = np.full((96, 128, 3), 128, np.uint8), np.zeros((1, 16, 16))
    maps[0, 3, 12] = 1
    shown = overlay(picture, maps, 1, [[20, 80]])
    assert shown.shape == picture.shape
    strength = np.abs(overlay(picture, maps).astype(int) - 128).sum(-1)
    v, u = np.unravel_index(strength.argmax(), strength.shape)
    assert abs(v - 3.5 * 6) <= 3 and abs(u - 12.5 * 8) <= 4
    marked = np.argwhere((shown != overlay(picture, maps)).any(-1))
    assert np.ptp(marked, axis=0).min() > 3 * 8  # a mark is as large as on the maps


def test_marks_outside_the_picture_are_not_seen_however_far():
    start, maps = np.full((16, 16, 3), 128, np.uint8), np.zeros((0, 16, 16))
    for pixel in ((20, 5), (5, -20), (-5.4e8, 5.4e8), (5, 3e38)):
        shown = overlay(start, maps, SCALE, np.array([pixel], np.float32),
                        np.array([pixel], np.float64))
        assert (shown == 128).all()
    for pixel in ((-0.5, 5), (5, 15.5)):  # at the border half of a mark is
        assert (overlay(start, maps, SCALE, [pixel]) != 128).any()
