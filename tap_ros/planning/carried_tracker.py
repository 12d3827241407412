# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The follower of the forward model, tracking.ObjectTracker, as a Tracker by clicks."""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.errors import TrackingError
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.tracking import ObjectTracker
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import HIDDEN, LOST, SEEN, Tracked, View
from tap_ros.weights import FORWARD_MODEL

CONFIDENCE = 0.8  # it does not know; about the share that is right in the simulator


class CarriedTracker:
    """
    A Tracker whose forward model was trained in the view of the camera; it finds no goals.

    :param camera: not used: the weights hold their own.
    """

    def __init__(self, camera: PinholeCamera | None = None) -> None:
        self._model = LearnedForwardModel.load(FORWARD_MODEL)
        self._scale = np.ones(2)
        self._pixels = np.zeros((0, 2))

    def select(self, view: View, pixels: Sequence[Sequence[float]] | np.ndarray) -> Tracked:
        """Follow other objects, at the clicks themselves; see Tracker."""
        height, width = view.image.shape[:2]
        clicks = np.asarray(pixels, np.float64).reshape(-1, 2)
        for u, v in clicks:
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                raise TrackingError(f'click ({u:g}, {v:g}) is outside the picture')
            if view.robot_mask is not None and view.robot_mask[round(v), round(u)]:
                raise TrackingError(f'click ({u:g}, {v:g}) is on the robot; move it away first')
        self._scale = self._model.config.image_size / np.array([width, height])
        self._pixels = clicks
        self._view, self._gripper = self._small(view), self._hand(view)
        small = ((clicks + 0.5) * self._scale - 0.5).astype(np.float32)
        self._follower = ObjectTracker(self._model, self._view, self._gripper, small)
        self._tracked = self._follower.start
        return self._state(view)

    def update(self, view: View) -> Tracked:
        """Carry the objects by what the gripper did since the last picture; see Tracker."""
        image, gripper = self._small(view), self._hand(view)
        action = np.append(gripper[:3] - self._gripper[:3], gripper[3])
        self._tracked = self._follower.update(
            self._tracked, self._view, self._gripper, action, image, gripper)
        self._view, self._gripper = image, gripper
        self._pixels = (self._tracked[0] + 0.5) / self._scale - 0.5
        return self._state(view)

    def find(self, view: View) -> Tracked:
        """Find nothing: all are LOST; see Tracker."""
        count = len(self._pixels)
        return Tracked(np.full((count, 2), np.nan), (LOST,) * count, np.zeros(count),
                       (np.zeros((0, 2)),) * count)

    def _small(self, view: View) -> np.ndarray:
        """Return the picture at the size of the model."""
        size = self._model.config.image_size
        return np.asarray(cv2.resize(view.image, (size, size), interpolation=cv2.INTER_AREA))

    @staticmethod
    def _hand(view: View) -> np.ndarray:
        """Return the gripper; TrackingError where it is not known."""
        if view.gripper is None:
            raise TrackingError('carried needs the gripper: publish joint states, or follow with '
                                'the tracker rigid')
        return np.asarray(view.gripper, np.float32)

    def _state(self, view: View) -> Tracked:
        """Return where the objects are; hidden where the mask says so."""
        states = []
        for u, v in self._pixels:
            mask = view.robot_mask
            inside = mask is not None and 0 <= v < mask.shape[0] - 0.5 and (
                0 <= u < mask.shape[1] - 0.5)
            states.append(HIDDEN if inside and mask is not None and mask[round(v), round(u)]
                          else SEEN)
        count = len(states)
        return Tracked(self._pixels, tuple(states), np.full(count, CONFIDENCE),
                       (np.zeros((0, 2)),) * count)
