# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A picture as it is searched: colours, lightness counting less, and what the robot hides."""

from copy import copy

import cv2
import numpy as np
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.protocols import View

SQUARE = np.ones((3, 3), np.uint8)  # what a mask is grown or shrunk by
FEW = 4  # colours of a Palette, at most
NEAR = 15.4  # distance from a colour of an object below which it has that colour
CHANGED = 8.0  # distance of colours that differ
TONE = 0.03  # of the light or of a channel, from which on a change is taken back
DARK, BRIGHT = 12, 243  # levels between which a change of light shows


class Metric:
    """
    A distance of colours: the sum over the axes of OpenCV's 8-bit Lab.

    :param lightness: weight of a step of L, beside steps of a and b.
    :param bits: of L, a and b in the index of a colour, 16 at most.
    """

    def __init__(self, lightness: float, bits: tuple[int, int, int]) -> None:
        levels, weights = np.arange(256), (lightness, 1, 1)
        self.weighed = np.rint(np.outer(levels, weights)).astype(np.uint8)[:, None]
        shifts = bits[1] + bits[2], bits[2], 0
        self.index = np.stack([levels >> 8 - n << shift for n, shift in zip(bits, shifts)],
                              -1).astype(np.uint16)[:, None]
        # the middles of the bins
        self.axes = np.ix_(*(np.float32(weight * ((np.arange(1 << n) + 0.5) * (256 >> n) - 0.5))
                             for n, weight in zip(bits, weights)))


# Shadows and the sides of a block change lightness first, so that it counts less, but for what
# differs from the table in that alone.
COLOUR, LIGHT = Metric(0.14, (3, 6, 6)), Metric(0.6, (6, 5, 5))


class Picture:
    """
    A View at the working size.

    :param like: picture whose light this one is given, where all of it is lighter or of another
        tint, or None.
    :ivar plane: Plane of its pixels.
    :ivar image: (h, w, 3) uint8.
    :ivar metric: Metric of lab and index.
    :ivar lab: (h, w, 3) uint8, lightness already weighed.
    :ivar index: (h, w) uint16, into tables of Palette.
    :ivar hidden: (h, w) bool, the robot and its shadow.
    """

    def __init__(self, view: View, plane: Plane, like: 'Picture | None' = None) -> None:
        self.plane, self.size = plane, plane.working
        h, w = self.size
        how = cv2.INTER_AREA if view.image.size > 3 * h * w else cv2.INTER_CUBIC
        image = np.asarray(cv2.resize(view.image, (w, h), interpolation=how))
        mask = np.zeros(self.size, np.uint8) if view.robot_mask is None else view.robot_mask
        self.hidden = np.asarray(cv2.resize(mask, (w, h), interpolation=cv2.INTER_NEAREST)) > 0
        self.image = image if like is None else self._toned(image, like)
        self._full = cv2.cvtColor(cv2.GaussianBlur(self.image, (3, 3), 0.7), cv2.COLOR_RGB2LAB)
        self._made = {COLOUR: self}
        self._weigh(COLOUR)

    def _weigh(self, metric: Metric) -> None:
        self.metric = metric
        self.lab = np.asarray(cv2.LUT(self._full, metric.weighed))
        self.index = np.asarray(cv2.transform(cv2.LUT(self._full, metric.index), np.ones((1, 3))))

    def by(self, metric: Metric) -> 'Picture':
        """Return the same picture by another metric."""
        if metric not in self._made:
            made = self._made[metric] = copy(self)
            made._weigh(metric)
        return self._made[metric]

    def _toned(self, image: np.ndarray, like: 'Picture') -> np.ndarray:
        """Return an image in the light of another picture: most of both shows the same."""
        here, there = image[::4, ::4], like.image[::4, ::4]
        both = ~(self.hidden | like.hidden)[::4, ::4] & (
            np.minimum(here, there).min(-1) > DARK) & (np.maximum(here, there).max(-1) < BRIGHT)
        if both.sum() < 50:
            return image
        gain = np.median(there[both] / here[both], 0)
        if (np.abs(np.log(gain)) < TONE).all():
            return image
        lut = np.rint(np.outer(np.arange(256), gain)).clip(0, 255).astype(np.uint8)[:, None]
        return np.asarray(cv2.LUT(image, lut))

    def changed(self, other: 'Picture') -> np.ndarray:
        """Return where (h, w) bool the colours differ."""
        return np.asarray(cv2.absdiff(self.lab, other.lab)).sum(-1) > CHANGED


class Palette:
    """
    A few colours, and how far any colour is from the nearest of them.

    :param colours: (N, 3) of Picture.lab, at least one.
    :param metric: Metric of these.
    :param least: share of the colours near one of them without which it is left out.
    """

    def __init__(self, colours: np.ndarray, metric: Metric = COLOUR, least: float = 0.0) -> None:
        centres = np.ascontiguousarray(colours, np.float32)
        if len(centres) > FEW:
            cv2.setRNGSeed(0)
            _, labels, found = cv2.kmeans(
                centres, FEW, np.zeros((len(centres), 1), np.int32), (3, 15, 1.0), 2,
                cv2.KMEANS_PP_CENTERS)
            shares = np.bincount(np.ravel(labels), minlength=FEW) / len(labels)
            centres = np.asarray(found)[shares >= min(least, shares.max())]
        self._far = np.array([sum(np.abs(axis - value) for axis, value in zip(
            metric.axes, centre)).ravel() for centre in centres])
        self._table = self._far.min(0)

    def distance(self, index: np.ndarray) -> np.ndarray:
        """Return the distances of colours by their index, any shape, float32."""
        return self._table.take(index)

    def recurs(self, index: np.ndarray, wanted: np.ndarray) -> float:
        """Return how alike the shares of each colour are of some colours and of wanted ones."""
        near = (self._far[:, index] < NEAR).mean(1)  # shades of one stand for another
        nearest = self._far[:, wanted].argmin(0)
        return float(np.minimum(near, np.bincount(nearest, minlength=len(near)) / len(
            wanted)).sum())
