# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Objects of the evaluation as a user has them: clicked once, then followed by a tracker."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.world.looks import LOOKS
from tap_ros.base.contract import CAMERA_SIZE, LOST
from tap_ros.base.errors import TrackingError
from tap_ros.base.plugins import load_plugin
from tap_ros.images.robot_mask import nearest_free
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import View

SLIP = 5.0  # px of it, up to which a click is off the middle of an object
CLICKS = 5  # at most
_camera = lru_cache(Simulator)  # takes the pictures that objects are followed in


class Follower:
    """
    Tells where the objects of an episode are, in place of the simulator.

    A click on each object in the first picture is all that comes from there; in the goal picture
    one on each object that is not found, as tracker_node asks for it. The tracker is shown
    CAMERA_SIZE pixels a side, the networks what they were trained on.

    :param tracker: of the plugin group tap_ros.trackers.
    :param simulator: Simulator.
    :ivar placed: names of objects that were clicked in the goal picture.
    """

    def __init__(self, tracker, simulator):
        self._simulator, self.placed = simulator, []
        self._camera = _camera(simulator.task_name, CAMERA_SIZE, next(
            name for name, look in LOOKS.items() if look is simulator.look))
        self._scale = CAMERA_SIZE / simulator.camera.width
        self._tracker = load_plugin('tap_ros.trackers', tracker)(PinholeCamera(
            self._camera.camera_matrix, (CAMERA_SIZE, CAMERA_SIZE), self._camera.camera_pose))

    def select(self, seen, seed):
        """Click on the objects; return the Observation with tracked pixels, and the states."""
        view, self._rng = _view(self._camera.reset(seed)), np.random.default_rng([seed, 0])
        for _ in range(CLICKS):  # who is refused clicks again
            try:
                return self._told(seen, self._tracker.select(
                    view, nearest_free(self._clicks(seen), view.robot_mask)))
            except TrackingError as refusal:
                reason = refusal
        raise reason

    def see(self, seen):
        """Follow the objects to the Observation of now; return as select."""
        self._camera.data.qpos[:] = self._simulator.data.qpos
        return self._told(seen, self._tracker.update(_view(self._camera.observe())))

    def find(self, goal):
        """Return the Observation of the goal with the pixels found in it, or clicked."""
        found = self._tracker.find(_view(self._camera.goal()))
        told = self._told(goal, found)[0]
        lost = np.array([state == LOST for state in found.states])
        self.placed = [name for name, is_lost in zip(goal.object_names, lost) if is_lost]
        return replace(told, object_pixels=np.where(
            lost[:, None], self._shrunk(self._clicks(goal)), told.object_pixels))

    def _clicks(self, observation):
        true = (observation.object_pixels + 0.5) * self._scale - 0.5
        return true + [slip(self._rng) for _ in true]

    def _shrunk(self, pixels):
        return ((pixels + 0.5) / self._scale - 0.5).astype(np.float32)

    def _told(self, observation, tracked):
        return replace(observation, object_pixels=self._shrunk(tracked.pixels)), tracked.states


def slip(rng):
    """Return how far (2,) px of CAMERA_SIZE a click is off, even over a disc."""
    angle = rng.uniform(0, 2 * np.pi)
    return SLIP * np.sqrt(rng.uniform()) * np.array([np.cos(angle), np.sin(angle)])


def _view(picture):
    return View(picture.image, picture.robot_mask, picture.gripper)
