# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of what pictures show at each frame."""

import numpy as np
import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.training.preference import describe, FEATURES, SIZE

CALM = FEATURES.index('speed')


def demonstration(seed):
    """Draw a square that crosses the picture and stands still somewhere; return where."""
    rng = np.random.default_rng(seed)
    pause, length = int(rng.integers(4, 17)), 24
    steps = rng.uniform(0.8, 1.2, length)
    steps[pause - 1:pause + 2] = 0.05
    frames = np.full((length, 24, 48, 3), 60, np.uint8)
    for frame, at in zip(frames, 2 + steps.cumsum()):
        frame[8:16, round(at):round(at) + 8] = rng.integers(150, 240, 3) // 10 * 10
    return frames, pause


def test_features_are_bounded_and_the_same_for_a_darker_camera():
    frames, pause = demonstration(5)
    found = describe(frames)
    assert found.shape == (24, SIZE) and np.isfinite(found).all()
    assert found[:, 10:].mean() == pytest.approx(0, abs=1e-5)
    assert found[:, 10:].std() == pytest.approx(1)
    assert found[:, [0, 2, 4, 5]].min() >= 0 and found[:, [0, 2, 4, 5]].max() == 1
    assert found[[0, -1], 1].tolist() == [-1, 1]
    assert abs(found[:, CALM].argmin() - pause) <= 1
    np.testing.assert_allclose(describe(frames // 2 + 10), found, atol=0.05)
    assert np.isfinite(describe(np.zeros((3, 8, 8, 3), np.uint8))).all()  # nothing ever moves
    with pytest.raises(ConfigError, match='2 frames'):
        describe(np.zeros((2, 8, 8, 3), np.uint8))


def test_what_is_hidden_changes_nothing():
    frames, _ = demonstration(7)
    hidden = np.zeros(frames.shape[:3], bool)
    hidden[:, :5] = hidden[4, 10:12] = True
    painted = np.where(hidden[..., None], 255 - frames, frames)
    np.testing.assert_array_equal(describe(painted, hidden), describe(frames, hidden))
    assert not np.array_equal(describe(painted), describe(frames))
    assert np.isfinite(describe(frames, np.ones_like(hidden))).all()
