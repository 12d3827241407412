# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Single clicks that are hard: on objects that the robot half hides, or as brown as the table."""

from dataclasses import replace

from experiments.planning.following import SLIP, slip
from experiments.tracks import fit_camera, RIGHT, SIDE, WRONG
import numpy as np
from sim_bridge.simulator import Simulator
from sim_bridge.world.table import lifted
from tap_ros.base.contract import CAMERA_SIZE, SEEN
from tap_ros.base.errors import TrackingError
from tap_ros.evaluation.intervals import bootstrap, share_interval
from tap_ros.images.robot_mask import nearest_free
from tap_ros.recording.cache import open_recordings
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.protocols import View
from tap_ros.tracking.rigid_tracker import RigidTracker

BODY, COVERED = 10.0, (0.2, 0.6)  # px around an object's middle; share of these behind the robot
EVERY, FOLLOWED = 3, 12  # pictures from one click to the next; in which it is followed then
LIFT = 30.0, 45.0  # levels of 255 that objects are lighter than the table


def score_covered(bags):
    """
    Click on objects of bags while the robot hides a part of them, and follow them.

    :return: rows of _rows; 'later' is of the last picture in which an object is followed.
    """
    found = []
    for store in map(open_recordings, bags):
        camera = fit_camera(store)
        for episode in store:
            rng = np.random.default_rng([episode.seed, 6])
            for t in range(0, len(episode.frames) - FOLLOWED, EVERY):
                for true in np.swapaxes(episode.object_pixels[t:t + FOLLOWED], 0, 1):
                    mask = episode.robot_masks[t]
                    if COVERED[0] <= _share_hidden(mask, true[0]) <= COVERED[1]:
                        click = nearest_free((true[0] + slip(rng))[None], mask)
                        found.append(_follow(RigidTracker(camera), episode, t, click, true))
    return _rows(found, 'half hidden')


def score_pale(task, look, seeds):
    """Click on objects that differ from the table in lightness alone; return rows of _rows."""
    simulator, found = Simulator(task, CAMERA_SIZE, look=look), []
    try:
        for seed in seeds:
            rng = np.random.default_rng([seed, 7])
            seen, scene = simulator.reset(seed), simulator.scene
            grey = _show(simulator, scene, seed, [(0.5,) * 3] * len(scene.shapes))
            wanted = [_table(seen, pixel) + rng.uniform(*LIFT) for pixel in seen.object_pixels]
            light = np.max([_top(grey, pixel) for pixel in grey.object_pixels], 0)
            seen = _show(simulator, scene, seed,
                         [(0.5 * one / light).clip(0, 1) for one in wanted])
            camera = PinholeCamera(
                simulator.camera_matrix, seen.image.shape[:2], simulator.camera_pose)
            for pixel in seen.object_pixels:
                if _share_hidden(seen.robot_mask, pixel) > 0:
                    continue
                try:
                    tracked = RigidTracker(camera).select(
                        View(seen.image, seen.robot_mask), [pixel + slip(rng)])
                except TrackingError:
                    found.append(None)
                    continue
                off = _off(tracked, pixel)
                found.append((off, off, tracked.confidence[0], SEEN))
    finally:
        simulator.close()
    return _rows(found, 'lightness alone')


def _show(simulator, scene, seed, colours):
    """Return the Observation of a scene whose objects have other colours, (r, g, b) 0 to 1."""
    shapes = [replace(shape, colours=(tuple(colour),) * len(shape.colours))
              for shape, colour in zip(scene.shapes, colours)]
    simulator.load(shapes, lifted(scene.start_poses), scene.gripper_start, seed)
    return simulator.observe()


def _follow(tracker, episode, t, click, true):
    """Return (error at once, error later, confidence, state later), None for a refusal."""
    def view(i):
        return View(episode.frames[i], episode.robot_masks[i], episode.grippers[i])

    try:
        first = last = tracker.select(view(t), click)
    except TrackingError:
        return None
    for i in range(t + 1, t + FOLLOWED):
        last = tracker.update(view(i))
    return _off(first, true[0]), _off(last, true[-1]), first.confidence[0], last.states[0]


def _rows(found, name):
    """Return rows as tracks.summarise does."""
    good = [one for one in found if one is not None]
    once, later, confidence = (np.array([one[i] for one in good], float) for i in range(3))
    seen = np.array([one[3] == SEEN for one in good], bool)
    stated = {
        'refused': share_interval([one is None for one in found]),
        'selected_px': bootstrap(lambda x: np.median(x, -1), once),
        'selected_within_2px': share_interval(once <= RIGHT),
        'later_within_2px': share_interval(later <= RIGHT),
        'wrong_sure': share_interval((later > WRONG) & seen),
        'confidence_at_once': bootstrap(lambda x: np.mean(x, -1), confidence)}
    return [{'recording': name, 'metric': metric, 'step': 0, 'value': round(float(value), 4),
             'ci_low': round(float(low), 4), 'ci_high': round(float(high), 4), 'n': len(found),
             'tracker': 'rigid', 'click_px': SLIP * SIDE / CAMERA_SIZE, 'size': CAMERA_SIZE}
            for metric, (value, low, high) in stated.items()]


def _off(tracked, true):
    return float(np.linalg.norm(tracked.pixels[0] - true) * SIDE / CAMERA_SIZE)


def _around(shape, pixel, near, far):
    y, x = np.ogrid[:shape[0], :shape[1]]
    apart = np.hypot(x - pixel[0], y - pixel[1])
    return (apart >= near) & (apart < far)


def _share_hidden(mask, pixel):
    """Return the share of a disc around a pixel that a mask covers; 0 without a pixel."""
    if not np.isfinite(pixel).all():
        return 0.0
    return float((mask[_around(mask.shape, pixel, 0, BODY)] > 0).mean())


def _table(seen, pixel):
    """Return the colour (3,) of the table around a pixel."""
    ring = _around(seen.image.shape, pixel, 26, 40) & (seen.robot_mask == 0)
    return np.median(seen.image[ring], 0)


def _top(seen, pixel):
    """Return the colour (3,) of what is at an object's middle: most often its top."""
    return np.median(seen.image[_around(seen.image.shape, pixel - (0, 4), 0, 3)], 0)
