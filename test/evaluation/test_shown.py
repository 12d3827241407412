# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the score that says whether hand and objects are shown."""


import cv2
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from tap_ros.evaluation.shown import ShownScorer
from tap_ros.images.robot_mask import fill_in_time

CARRYING = 8  # a frame in which the hand is at the object


@pytest.fixture(scope='module')
def episode():
    return Simulator('pick_place', 64, 'hand').demonstrate(3).episode


def test_the_matched_frame_shows_all_and_the_one_without_the_hand_no_hand(episode):
    scorer = ShownScorer(episode)
    bare = fill_in_time(episode.frames, episode.robot_masks, 'all')[0]
    for t in range(2, len(episode), 5):
        assert scorer.score(episode.frames[t] / 255, t) == pytest.approx((1, 1), abs=1e-5)
        hand, objects = scorer.score(bare[t] / 255, t)
        assert hand == pytest.approx(0, abs=1e-5) and objects == pytest.approx(1, abs=1e-5)


def test_an_object_that_is_painted_over_is_not_shown(episode):
    t = 2  # before the hand comes near
    u, v = episode.object_pixels[t, 0]
    y, x = np.mgrid[:64, :64]
    disc = (np.hypot(x - u, y - v) < 7).astype(np.uint8)
    without = cv2.inpaint(episode.frames[t], disc, 3, cv2.INPAINT_NS)
    hand, objects = ShownScorer(episode).score(without / 255, t)
    assert hand > 0.9 and objects < 0.3
