# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether the pictures of one topic alternate between several views.

Two cameras that were started with one name publish on one topic. Told by what the pictures show:
again and again a picture is nothing like the one before it, but like one a little earlier. Only
the order of neighbouring brightnesses counts, so that light may flicker.
"""

from functools import cache

import numpy as np

SAMPLES = 16  # of a picture, along each side
_LEAST = 6  # of 255; neighbours that differ by less are alike
_FEATURES = 24  # of a picture; those with less are of nothing, such as black ones
_OTHER = 0.4  # from 0 to 1; so different are two views at least
_SAME = 0.3  # of that difference, at most: the view is that of an earlier picture
_BACK = 8  # so much earlier, in pictures
_RETURNS, _CUTS, _WITHIN = 8, 12, 72  # so many of so many cuts return, in so many pictures


def look(picture: np.ndarray) -> bytes:
    """Return what is kept of a picture, (H, W, 3) uint8: SAMPLES * SAMPLES of its greens."""
    return picture.reshape(-1, 3)[_places(*picture.shape[:2]), 1].tobytes()


@cache
def _places(height: int, width: int) -> np.ndarray:
    """Return which pixels of a picture are kept."""
    rows, columns = ((2 * np.arange(SAMPLES) + 1) * n // (2 * SAMPLES) for n in (height, width))
    return rows[:, None] * width + columns


def first_return(looks: bytes | bytearray) -> int | None:
    """
    Find where pictures begin to alternate between views.

    :param looks: those of N pictures, in the order in which they were taken.
    :return: number of the first picture that shows another view; None where
        all may be of one camera.
    """
    shown = np.frombuffer(looks, np.uint8).reshape(-1, SAMPLES, SAMPLES).astype(np.int16)
    if len(shown) <= _RETURNS:
        return None
    signs = np.concatenate([
        np.sign(steps * (np.abs(steps) >= _LEAST)).reshape(len(shown), -1).astype(np.int8)
        for steps in (np.diff(shown, axis=1), np.diff(shown, axis=2))], 1)
    features = np.abs(signs).sum(1, dtype=np.int32)

    def differ(rows: np.ndarray, back: int) -> np.ndarray:
        """Return from 0 to 1 how pictures differ from those so much earlier."""
        others = np.maximum(rows - back, 0)
        least = np.minimum(features[rows], features[others])
        return np.where((least >= _FEATURES) & (rows >= back), np.abs(
            signs[rows] - signs[others]).sum(1, dtype=np.int32) / np.maximum(
                features[rows] + features[others], 1), np.nan)
    before = differ(np.arange(len(shown)), 1)
    cuts = np.flatnonzero(before > _OTHER)
    if len(cuts) < _RETURNS:
        return None
    nearest = np.fmin.reduce([differ(cuts, back) for back in range(2, _BACK + 1)])
    returns = np.append(0, np.cumsum(nearest < _SAME * before[cuts]))
    cuts = np.append(cuts, len(shown))
    for first in range(max(len(cuts) - _CUTS, 1)):
        last = min(first + _CUTS, len(cuts) - 1)
        if (returns[last] - returns[first] >= _RETURNS
                and cuts[last - 1] - cuts[first] < _WITHIN):
            return int(cuts[first])
    return None
