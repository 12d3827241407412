# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A picture as it is searched: colours, lightness counting less, and what the robot hides."""

import cv2
import numpy as np
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.protocols import View

LIGHTNESS = 0.14  # weight of a step of L of OpenCV's 8-bit Lab, beside steps of a and b
FEW = 4  # colours of a Palette, at most
_LEVELS = np.arange(256)
_WEIGHED = np.rint(np.outer(_LEVELS, (LIGHTNESS, 1, 1))).astype(np.uint8)[:, None]
# The index of a colour has 3, 6 and 6 bits of L, a and b; and the middles of their bins.
_INDEX = np.stack([_LEVELS >> 5 << 12, _LEVELS >> 2 << 6, _LEVELS >> 2], -1).astype(
    np.uint16)[:, None]
_AXES = np.ix_(*(np.float32(weight * ((np.arange(bins) + 0.5) * 256 / bins - 0.5))
                 for bins, weight in ((8, LIGHTNESS), (64, 1), (64, 1))))


class Picture:
    """
    A View at the working size.

    Distances of colours are the sum over the axes of Lab, lightness weighed less: shadows and
    the sides of a block change that first.

    :ivar image: (h, w, 3) uint8.
    :ivar lab: (h, w, 3) uint8, lightness already weighed.
    :ivar index: (h, w) uint16, into tables of Palette.
    :ivar hidden: (h, w) bool, the robot and its shadow.
    """

    def __init__(self, view: View, plane: Plane) -> None:
        h, w = self.size = plane.working
        image = view.image
        if image.shape[:2] != self.size:
            smaller = image.shape[0] > h or image.shape[1] > w
            image = np.asarray(cv2.resize(
                image, (w, h), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC))
        self.image = image
        lab = cv2.cvtColor(cv2.GaussianBlur(image, (3, 3), 0.7), cv2.COLOR_RGB2LAB)
        self.lab = np.asarray(cv2.LUT(lab, _WEIGHED))
        parts: list[np.ndarray] = [np.asarray(part) for part in cv2.split(cv2.LUT(lab, _INDEX))]
        self.index: np.ndarray = np.bitwise_or(np.bitwise_or(parts[0], parts[1]), parts[2])
        mask = np.zeros(self.size, np.uint8) if view.robot_mask is None else view.robot_mask
        self.hidden = np.asarray(mask if mask.shape == self.size else cv2.resize(
            mask, (w, h), interpolation=cv2.INTER_NEAREST)) > 0

    def apart(self, other: 'Picture') -> np.ndarray:
        """Return the distance (h, w) float32 of the colours of each pixel."""
        return np.asarray(cv2.transform(
            cv2.absdiff(self.lab, other.lab).astype(np.float32), np.ones((1, 3))))


def weighed(image: np.ndarray) -> np.ndarray:
    """Return the colours (..., 3) uint8 of an rgb picture as Picture.lab has them."""
    return np.asarray(cv2.LUT(cv2.cvtColor(image, cv2.COLOR_RGB2LAB), _WEIGHED))


class Palette:
    """
    A few colours, and how far any colour is from the nearest of them.

    :param colours: (N, 3) of Picture.lab, at least one.
    :param least: share of the colours near one of them without which it is left out.
    """

    def __init__(self, colours: np.ndarray, least: float = 0.0) -> None:
        centres = np.ascontiguousarray(colours, np.float32)
        if len(centres) > FEW:
            cv2.setRNGSeed(0)
            _, labels, found = cv2.kmeans(
                centres, FEW, np.zeros((len(centres), 1), np.int32), (3, 15, 1.0), 2,
                cv2.KMEANS_PP_CENTERS)
            shares = np.bincount(np.ravel(labels), minlength=FEW) / len(labels)
            centres = np.asarray(found)[shares >= min(least, shares.max())]
        self._table = np.min([sum(np.abs(axis - value) for axis, value in zip(_AXES, centre))
                              for centre in centres], 0).ravel()

    def distance(self, index: np.ndarray) -> np.ndarray:
        """Return the distances of colours by their index, any shape, float32."""
        return self._table.take(index)
