# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of following objects through pictures, with pushes in the real simulator."""

import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.planning.tracking import ObjectTracker
from tap_ros.weights import FORWARD_MODEL


@pytest.fixture(scope='module')
def learned():
    return LearnedForwardModel.load(FORWARD_MODEL)


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


def push(simulator, seed):
    """Push object 0 towards the middle; yield what was seen before, the action, and after."""
    seen = simulator.reset(seed)
    target = seen.object_poses[0, :2]
    along = -target / np.linalg.norm(target)
    behind = target - 0.13 * along
    actions = [[0, 0, 0.13 - seen.gripper[2], 0]]
    actions += [[*(behind - seen.gripper[:2]) / 12, 0, 0]] * 12
    actions += [[0, 0, -0.118, 0]] + [[*0.035 * along, 0, 0]] * 7
    for action in np.array(actions, np.float32):
        before, seen = seen, simulator.step(action)
        yield before, action, seen


def test_what_stands_still_stays_where_it_is(learned, simulator):
    seen = simulator.reset(31)
    tracker = ObjectTracker(learned, seen.image, seen.gripper, seen.object_pixels)
    for _ in range(3):
        action = np.array([0.02, 0, 0.13 - seen.gripper[2], 0], np.float32)
        before, seen = seen, simulator.step(action)
        found = tracker.update(before.image, before.gripper, action, seen.image, seen.gripper)
    assert np.abs(found - seen.object_pixels).max() < 0.6


def test_a_pushed_object_is_followed_better_than_by_the_model_alone(learned, simulator):
    errors, moved = [], []
    for seed in (30, 31):
        tracker = None
        for before, action, seen in push(simulator, seed):
            if tracker is None:
                first = before.object_pixels
                tracker = ObjectTracker(learned, before.image, before.gripper, first)
            found = tracker.update(before.image, before.gripper, action, seen.image, seen.gripper)
        errors.append(np.linalg.norm(found - seen.object_pixels, axis=1))
        moved.append(np.linalg.norm(first - seen.object_pixels, axis=1))
    assert np.max(moved) > 4 and np.mean(errors) < 1.0 and np.max(errors) < 2.5


def test_the_picture_corrects_a_wrong_place(learned, simulator):
    seen = simulator.reset(31)
    tracker = ObjectTracker(learned, seen.image, seen.gripper, seen.object_pixels)
    tracker.pixels = seen.object_pixels + np.array([0.8, 0], np.float32)
    still = np.array([0, 0, 0.13 - seen.gripper[2], 0], np.float32)
    before, seen = seen, simulator.step(still)
    found = tracker.update(before.image, before.gripper, still, seen.image, seen.gripper)
    assert np.linalg.norm(found - seen.object_pixels, axis=1).max() < 0.5
