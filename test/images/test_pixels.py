# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Resized pictures, and positions in them."""

import numpy as np
from tap_ros.images.pixels import resize_image


def test_an_even_picture_stays_even_and_no_column_is_passed_over_when_resizing():
    even = np.full((9, 7, 3), (200, 3, 77), np.uint8)
    for size in ((4, 3), (9, 14), (31, 2)):
        resized = resize_image(even, size)
        assert resized.shape == (*size, 3) and resized.dtype == np.uint8
        assert (resized == even[0, 0]).all()
    lines = np.zeros((8, 32, 3), np.uint8)
    lines[:, 0::4] = lines[:, 3::4] = 240  # what lies between the places looked at, too, counts
    resized = resize_image(lines, (8, 8))
    assert np.ptp(resized[:, 1:-1]) == 0 and 60 < resized[4, 4, 0] < 140
    step = np.zeros((1, 4, 3), np.uint8)
    step[:, 2:] = 255
    assert (np.diff(resize_image(step, (1, 16))[0, :, 0].astype(int)) >= 0).all()
