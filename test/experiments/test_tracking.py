# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of scoring trackers; a tracker of another package is scored by its name."""

from importlib.metadata import EntryPoint

from experiments.tracks import fit_camera, follow, recoveries, summarise
import numpy as np
import pytest
from tap_ros.base import plugins
from tap_ros.base.contract import LOST, SEEN
from tap_ros.base.errors import TrackingError
from tap_ros.recording.episode import Episode
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import Tracked

T, SIZE = 12, 64


def made_episode(camera=None):
    """Return an episode of two objects, the first of which the robot covers from 4 to 6."""
    rng = np.random.default_rng(0)
    poses = np.zeros((T, 2, 7))
    poses[..., :2], poses[..., 2] = rng.uniform(-0.3, 0.3, (T, 2, 2)), 0.03
    pixels = np.stack([np.tile([20.0 + k, 30 - k], (T, 1)) + np.arange(T)[:, None]
                       for k in (0, 20)], 1).astype(np.float32)
    if camera is not None:
        seen = np.linalg.inv(camera.pose)
        rays = (poses[..., :3] @ seen[:3, :3].T + seen[:3, 3]) @ camera.K.T
        pixels = (rays[..., :2] / rays[..., 2:]).astype(np.float32)
    masks = np.zeros((T, SIZE, SIZE), np.uint8)
    for t in (4, 5, 6):
        masks[t, round(pixels[t, 0, 1].item()), round(pixels[t, 0, 0].item())] = 255
    return Episode(
        np.zeros((T, SIZE, SIZE, 3), np.uint8), np.arange(T), np.zeros((T, 4), np.float32),
        np.zeros((T, 4), np.float32), ('a', 'b'), pixels, poses,
        np.zeros((SIZE, SIZE, 3), np.uint8), pixels[-1], poses[-1], robot_masks=masks)


class Told:
    """A Tracker that knows where objects go, but for an error, and refuses one click."""

    def __init__(self, camera=None, error=0.0, state=SEEN, refuse=None):
        self.error, self.state, self.refuse = error, state, refuse

    def select(self, view, pixels):
        self.pixels = np.array(pixels, float).reshape(-1, 2)
        if self.refuse is not None and (np.abs(self.pixels - self.refuse) < 1e-3).all(1).any():
            raise TrackingError('no object')
        return self._tracked(self.pixels)

    def update(self, view):
        self.pixels = self.pixels + 1
        return self._tracked(self.pixels + (self.error, 0))

    def find(self, view):
        return self._tracked(self.pixels + (self.error, 0))

    def _tracked(self, pixels):
        count = len(pixels)
        return Tracked(pixels, (self.state,) * count, np.full(count, 0.9),
                       (np.zeros((0, 2)),) * count)


def scores(**options):
    """Return the values of a told tracker by metric."""
    track = follow(lambda: Told(**options), made_episode())
    return {row['metric']: row['value'] for row in summarise([track], 'made')}, track


def test_the_truth_scores_best_and_what_is_wrong_is_told_by_its_state():
    best, track = scores()
    assert (best['median_px'], best['within_2px'], best['wrong_sure']) == (0, 1, 0)
    assert best['recovered'] == best['goal_right'] == 1 and recoveries(track) == [True]
    sure, _ = scores(error=3.5)
    assert (sure['within_2px'], sure['wrong_sure'], sure['goal_wrong']) == (0, 1, 1)
    assert sure['longest_wrong_sure'] == T - 1 and sure['recovered'] == 0
    lost, _ = scores(error=3.5, state=LOST)
    assert (lost['wrong_sure'], lost['lost'], lost['goal_refused']) == (0, 1, 1)


def test_a_refused_click_is_counted_and_the_others_are_followed():
    found, track = scores(refuse=(20, 30))
    assert found['refused'] == 0.5 and track.errors.shape == (T - 1, 1)


def test_a_camera_is_fitted_to_where_objects_truly_are():
    tilt = np.array([[1, 0, 0], [0, -0.75, 0.66], [0, -0.66, -0.75]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = tilt / np.linalg.norm(tilt, axis=0), (0.0, -1.1, 1.3)
    pose[:3, :3] = np.linalg.qr(pose[:3, :3])[0] * np.sign(np.diag(np.linalg.qr(pose[:3, :3])[1]))
    camera = PinholeCamera(np.array([[105.0, 0, 31.5], [0, 105, 31.5], [0, 0, 1]]), (64, 64), pose)
    found = fit_camera([made_episode(camera)])
    assert found.K == pytest.approx(camera.K, abs=0.5)
    assert found.pose == pytest.approx(pose, abs=0.01)


def test_a_tracker_of_another_package_is_found_by_name(monkeypatch):
    point = EntryPoint('told', 'test_tracking:Told', 'tap_ros.trackers')
    monkeypatch.setattr(plugins, 'entry_points', lambda group, name=None: [
        point for name in [name or point.name] if (group, name) == (point.group, point.name)])
    make = plugins.load_plugin('tap_ros.trackers', 'told')
    assert (follow(lambda: make(None), made_episode()).errors < 1e-5).all()
