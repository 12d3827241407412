# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A picture as it is searched: colours, lightness counting less, and what the robot hides."""

import cv2
import numpy as np
from tap_ros.tracking.plane import Plane
from tap_ros.tracking.protocols import View

LIGHTNESS = 0.14  # weight of a step of L of OpenCV's 8-bit Lab, beside steps of a and b
# The middles of the bins of L, a and b in a colour's index: 3, 6 and 6 bits.
_AXES = np.ix_(*(weight * (np.arange(bins, dtype=np.float32) + 0.5) * (256 // bins) - 0.5 * weight
                 for bins, weight in ((8, np.float32(LIGHTNESS)), (64, np.float32(1)),
                                      (64, np.float32(1)))))


class Picture:
    """
    A View at the working size.

    Distances of colours are the sum over the axes of Lab, lightness weighed less: shadows and
    the sides of a block change that first.

    :ivar image: (h, w, 3) uint8.
    :ivar lab: (3, h * w) float32.
    :ivar index: (h * w,) uint16, into tables of Palette.
    :ivar hidden: (h, w) bool, the robot and its shadow.
    """

    def __init__(self, view: View, plane: Plane) -> None:
        h, w = self.size = plane.working
        image = view.image
        if image.shape[:2] != self.size:
            smaller = image.shape[0] > h or image.shape[1] > w
            image = cv2.resize(
                image, (w, h), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
        self.image = image
        lab = np.asarray(cv2.cvtColor(cv2.GaussianBlur(image, (3, 3), 0.7), cv2.COLOR_RGB2LAB))
        L, a, b = np.moveaxis(lab, -1, 0)
        self.lab = np.empty((3, h * w), np.float32)
        np.multiply(L.ravel(), LIGHTNESS, out=self.lab[0], casting='unsafe')
        self.lab[1], self.lab[2] = a.ravel(), b.ravel()
        self.index = ((L >> 5).astype(np.uint16) << 12 | (a >> 2).astype(np.uint16) << 6
                      | b >> 2).ravel()
        if view.robot_mask is None:
            self.hidden = np.zeros(self.size, bool)
        else:
            mask = np.asarray(view.robot_mask)
            self.hidden = (mask if mask.shape == self.size else cv2.resize(
                mask, (w, h), interpolation=cv2.INTER_NEAREST)) > 0

    def colours(self, mask: np.ndarray) -> np.ndarray:
        """Return the colours (N, 3) float32 where a mask (h, w) holds."""
        return self.lab[:, mask.ravel()].T


class Palette:
    """
    A few colours, and how far any colour is from the nearest of them.

    :param colours: (N, 3) float32 of Picture.colours, at least one.
    """

    def __init__(self, colours: np.ndarray, count: int = 4) -> None:
        colours = np.ascontiguousarray(colours, np.float32)
        if len(colours) > count:
            cv2.setRNGSeed(0)
            colours = cv2.kmeans(
                colours, count, np.zeros((len(colours), 1), np.int32), (3, 15, 1.0), 2,
                cv2.KMEANS_PP_CENTERS)[2]
        self.centres = colours
        self._table = np.min([sum(np.abs(axis - value) for axis, value in zip(_AXES, centre))
                              for centre in self.centres], 0).ravel()

    def distance(self, picture: Picture) -> np.ndarray:
        """Return the distance (h, w) float32 of every pixel."""
        return self._table[picture.index].reshape(picture.size)

    def look_up(self, index: np.ndarray) -> np.ndarray:
        """Return the distances of colours by their index."""
        return self._table[index]
