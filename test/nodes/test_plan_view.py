# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the plans that are drawn over pictures."""

from types import SimpleNamespace

import numpy as np
from sim_bridge.world.looks import get_look
from tap_ros.base.contract import WORKSPACE_HIGH, WORKSPACE_LOW
from tap_ros.images.drawing import OBJECT_COLOURS
from tap_ros.nodes.planner import plan_view
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
from tap_ros.weights import FORWARD_MODEL

# Observation from above: 60 px a metre, and what is higher is seen farther up, by 40 px a metre.
ABOVE = ForwardModelConfig(
    table=(60, 0, 32, 0, -60, 32, 0, 0, 1), arm=(60, 0, 0, 35, 0, -60, -40, 30, 0, 0, 0, 1))
HAND = np.array([0.1, -0.2, 0.05, 0.5], np.float32)
GREY = np.full((64, 64, 3), 90, np.uint8)
TARGETS = np.array([[20, 10], [50, 20]], np.float32)


def plan_of(*elites):
    """Return a plan that takes the first of these sequences of moves."""
    return SimpleNamespace(actions=np.array(elites[0], float), elites=np.array(elites, float))


def straight(x, y, steps=15):
    return np.tile([x / steps, y / steps, 0, 0], (steps, 1))


def shown(canvas, pixel):
    """Return the colour at a pixel (u, v) of the picture before it was enlarged."""
    u, v = ((np.asarray(pixel) + 0.5) * len(canvas) / 64).astype(int)
    return tuple(canvas[v, u].tolist())


def test_fingertips_are_drawn_where_the_camera_sees_them():
    camera = get_look('hand').camera(False, 64, 64)
    config = LearnedForwardModel.load(FORWARD_MODEL).config
    points = np.random.default_rng(0).uniform(WORKSPACE_LOW, WORKSPACE_HIGH, (200, 3))
    seen = plan_view.fingertip_pixels(config, points)
    gaps = np.linalg.norm(seen - camera.project(points), axis=1)
    assert gaps.max() < 3 and gaps.mean() < 1.5
    # At the table, where objects are pushed, the arm's offset counts for nothing.
    low = np.array([[0.2, -0.1, 0.0]])
    np.testing.assert_allclose(plan_view.fingertip_pixels(ABOVE, low), [[44, 38]])
    np.testing.assert_allclose(plan_view.fingertip_pixels(ABOVE, low + [0, 0, 0.1]), [[44, 34]])


def test_all_ways_the_targets_and_the_gripper_are_where_they_belong():
    ways = [straight(-0.3, 0), straight(0.2, 0.4), straight(-0.1, 0.5)]
    canvas = plan_view.draw_plan(GREY, ABOVE, plan_of(*ways), HAND, TARGETS)
    side = 64 * plan_view.SCALE
    assert canvas.shape == (side, side, 3) and canvas.dtype == np.uint8
    middle = [plan_view.fingertip_pixels(ABOVE, plan_view.way(one, HAND)[8:9])[0] for one in ways]
    assert shown(canvas, middle[0]) == plan_view.CHOSEN
    for place in middle[1:]:  # a thin line has no pixel of its own colour alone
        assert np.abs(np.subtract(shown(canvas, place), plan_view.ELITES)).max() < 60
    here, = plan_view.fingertip_pixels(ABOVE, HAND[None, :3].astype(float))
    assert shown(canvas, here) == plan_view.GRIPPER
    for k, target in enumerate(TARGETS):
        assert shown(canvas, target) == OBJECT_COLOURS[k]
    touched = (canvas != 90).any(-1).mean()
    assert 0.01 < touched < 0.1, 'most of the picture stays as it is'
    camera = np.random.default_rng(0).integers(80, 100, (256, 256, 3), np.uint8)
    sharp = plan_view.draw_plan(GREY, ABOVE, plan_of(*ways), HAND, TARGETS, camera)
    assert sharp.shape == canvas.shape and shown(sharp, middle[0]) == plan_view.CHOSEN
    assert ((np.abs(sharp.astype(int) - canvas) > 20).any(-1)).mean() < 0.02 < sharp[:9].std()
    wide = plan_view.draw_plan(
        np.zeros((160, 320, 3), np.uint8), ABOVE, plan_of(*ways), HAND, TARGETS)
    assert wide.shape[1] == plan_view.LARGEST
    far = ForwardModelConfig(table=(60, 0, 1e9, 0, -60, 32, 0, 0, 1), arm=ABOVE.arm)
    nowhere = np.array([[np.nan, 3], [1e30, -1e30]], np.float32)
    canvas = plan_view.draw_plan(GREY, far, plan_of(*ways), HAND, nowhere)
    np.testing.assert_array_equal(canvas, 90)
