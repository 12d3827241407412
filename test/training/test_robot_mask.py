# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a robot hides is filled with what was seen there, nearest in time or last."""

import dataclasses

from made_episodes import cover, make_episode, write_bag
import numpy as np
import pytest
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import RecordingError, RecordingWarning
from tap_ros.images.robot_mask import (
    fill_from_past,
    fill_in_time,
    FreeView,
    hidden_pixels,
)
from tap_ros.recording.cache import open_recordings
from tap_ros.training.frames import FilledStore, GOAL, ResidentFrames
from tap_ros.training.split import with_masks


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Give each test a cache of its own."""
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path / 'cache'))


def random_masks(T, seed=0):
    """Draw masks that hide most, and some pixels always or never."""
    values = [ROBOT_MASK_FREE, ROBOT_MASK_HAND, ROBOT_MASK_ARM]
    masks = np.random.default_rng(seed).choice(values, (T, 8, 12)).astype(np.uint8)
    masks[:, 0], masks[:, 1] = ROBOT_MASK_ARM, ROBOT_MASK_FREE
    return masks


@pytest.mark.parametrize('robot_mask', ['arm', 'all'])
def test_hidden_is_filled_by_the_nearest_frame_in_time_and_in_a_stream_by_the_last(robot_mask):
    T = 7
    frames, masks = make_episode(1, T=T).frames, random_masks(T)
    masks[:, 2] = ROBOT_MASK_HAND
    hidden, view = hidden_pixels(masks, robot_mask), FreeView(robot_mask)
    filled, seen = fill_in_time(frames, masks, robot_mask)
    streamed = np.stack([view.update(*both) for both in zip(frames, masks)])
    np.testing.assert_array_equal(fill_from_past(frames, masks, robot_mask)[0], streamed)
    for t, v, u in np.ndindex(hidden.shape):
        free = [s for s in range(T) if masks[s, v, u] == ROBOT_MASK_FREE]
        past = [s for s in free if s <= t]
        nearest = min(free, key=lambda s: (abs(s - t), s)) if free and hidden[t, v, u] else t
        last = past[-1] if past and hidden[t, v, u] else t
        assert filled[t, v, u].tolist() == frames[nearest, v, u].tolist()
        assert streamed[t, v, u].tolist() == frames[last, v, u].tolist()
        assert seen[v, u] == (bool(free) or not hidden[:, v, u].any())


def test_filled_recordings_are_read_like_recordings(tmp_path, robot_mask='arm'):
    plain = make_episode(9, T=4, start=10**12)
    episodes = [cover(make_episode(s, T=5 + s, start=(s + 1) * 10**10), seed=s) for s in range(3)]
    episodes.append(dataclasses.replace(episodes[0], goal_mask=None, stamps=episodes[0].stamps
                                        + 5 * 10**11))
    store = open_recordings([
        write_bag(tmp_path / 'a', episodes), write_bag(tmp_path / 'b', [plain])])
    found = FilledStore(store, robot_mask)
    assert len(found) == 5 and found.num_frames == store.num_frames
    for i, episode in enumerate(episodes):
        expected, seen = fill_in_time(episode.frames, episode.robot_masks, robot_mask)
        np.testing.assert_array_equal(found.frames(i), expected)
        np.testing.assert_array_equal(found[i].frames, expected)
        np.testing.assert_array_equal(found.seen[i], seen)
        behind = fill_in_time(episode.frames, episode.robot_masks, 'all')[0][-1]
        goal = expected[-1] if i == 3 else np.where(
            hidden_pixels(episode.goal_mask, robot_mask)[..., None], behind, episode.goal_frame)
        np.testing.assert_array_equal(found[i].goal_frame, goal)
    np.testing.assert_array_equal(found.frames(4), plain.frames)
    np.testing.assert_array_equal(found[4].goal_frame, plain.goal_frame)
    assert found.seen[4].all()
    chosen, times = [3, 4, 0], np.array([[0, 1, GOAL], [GOAL, 2, 3], [1, 1, 4]])
    assert found.gather(chosen, times).equal(ResidentFrames(found, 'cpu')(chosen, times))


def test_only_episodes_with_masks_are_trained_on(tmp_path):
    masked = [cover(make_episode(s, start=(s + 1) * 10**10)) for s in range(2)]
    plain = [make_episode(s, start=(s + 1) * 10**10) for s in range(2, 4)]
    store = open_recordings([write_bag(tmp_path / 'a', masked), write_bag(tmp_path / 'b', plain)])
    parts = np.array([0, 2, 3]), np.array([1])
    assert with_masks(store, parts, 'none') is parts
    with pytest.warns(RecordingWarning, match='2 of 4 episodes are left out'):
        training, held_out = with_masks(store, parts, 'arm')
    assert training.tolist() == [0] and held_out.tolist() == [1]
    with pytest.raises(RecordingError, match='0 of 2 to train on .* record /camera/robot_mask .* '
                                             '--robot-mask none'):
        with_masks(store, (np.array([2, 3]), np.array([1])), 'all')
