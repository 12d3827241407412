# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What follows objects in pictures, as tracker_node and the evaluation use it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class View:
    """A picture, and what is known of the robot in it."""

    image: np.ndarray  # (H, W, 3) uint8 rgb8, of the camera's own size
    robot_mask: np.ndarray | None = None  # (H, W) uint8, 0 where the robot is not; None: not known
    gripper: np.ndarray | None = None  # (4,) x, y, z in metres, and opening; None: not known


@dataclass(frozen=True)
class Tracked:
    """
    Where K objects are in a picture.

    The pixel of an object is where the camera sees its middle. That of an object that is hidden,
    unsure or lost is the last one that was known; NaN where none ever was.
    """

    pixels: np.ndarray  # (K, 2) float64 (u, v)
    states: tuple[str, ...]  # K of SEEN, HIDDEN, UNSURE, LOST
    confidence: np.ndarray  # (K,) probability, 0 to 1, that the pixel is right within 2 px of 64
    outlines: tuple[np.ndarray, ...]  # K of (N, 2) pixels, each a closed polygon; N may be 0


class Tracker(Protocol):
    """
    Follows objects that are selected in a first picture.

    A class is made with a camera (robots.silhouette.PinholeCamera, its pose in the frame of the
    table, whose top is z = 0) or None: without calibration. Names: tap_ros.base.plugins.
    """

    def select(self, view: View, pixels: Sequence[Sequence[float]] | np.ndarray,
               drawn: Sequence[np.ndarray] = ()) -> Tracked:
        """
        Follow these objects from this picture on, in place of those before.

        :param pixels: (K, 2), a click on each object.
        :param drawn: K outlines (N, 2), or N = 0 where the object is to be cut out; () for none.
        :return: each at the middle of its silhouette.
        :raises TrackingError: for a click outside the picture, on the robot, beyond the table,
            or on nothing that differs from it; then those before are followed on.
        """

    def update(self, view: View) -> Tracked:
        """Return where they are in the next picture; select comes first."""

    def find(self, view: View) -> Tracked:
        """
        Return where they are in another picture of the scene, such as that of a goal.

        What is not found has the state LOST. The objects are followed on as before.
        """
