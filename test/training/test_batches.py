# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of training batches and of augmentation."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.recording.cache import open_recordings
from tap_ros.training.augmentation import Augmentation
from tap_ros.training.batches import (
    episode_order,
    make_batch,
    Pictures,
    Sampling,
    target_times,
    uses_recorded_goal,
)
import torch


@pytest.fixture
def store(bag):
    return open_recordings([bag], progress=False)


def test_targets_are_the_frames_between_the_context_pictures(store):
    batch = make_batch(store, [0, 3])
    for b, i in enumerate([0, 3]):
        frames = store.frames(i)
        assert np.array_equal(batch.context[b], frames[[0, -1]])
        assert batch.times[b][batch.valid[b]].tolist() == list(range(1, len(frames) - 1))
        assert np.array_equal(batch.targets[b][batch.valid[b]], frames[1:-1])
        assert batch.end[b].item() == len(frames) - 1
        assert (batch.first[b].item(), batch.last[b].item()) == (1, len(frames) - 2)
    assert batch.valid.sum(1).tolist() == [5, 8]


def test_margins_leave_at_least_one_target_and_forward_all_later_frames_are_some(store):
    for end, margin, forward, expected in (
            (39, 3, False, (4, 35)), (8, 3, False, (4, 4)), (2, 3, False, (1, 1)),
            (5, 9, False, (2, 3)), (14, 3, True, (4, 14)), (2, 5, True, (2, 2))):
        assert target_times(end, margin, forward) == expected
    batch, frames = make_batch(store, [3], Sampling(forward=True)), store.frames(3)
    assert np.array_equal(batch.context[0], frames[:1])
    assert np.array_equal(batch.targets[0], frames[1:])


def test_fixed_time_is_a_share_of_the_episode(store):
    batch = make_batch(store, [0], Sampling(fraction=0.5))
    assert np.array_equal(batch.targets[0, 0], store.frames(0)[3])
    end = store.lengths[4] - 1
    for fraction, expected in ((0.01, 1), (0.25, int(0.25 * end + 0.5)), (1.0, end)):
        batch = make_batch(store, [4], Sampling(fraction=fraction, forward=True))
        assert batch.times.tolist() == [[expected]]
    assert make_batch(store, [4], Sampling(fraction=1.0)).times.tolist() == [[end - 1]]


def test_the_video_is_the_whole_episode(store):
    batch = make_batch(store, [0, 4], Sampling(margin=2, num_targets=2, video_frames=7))
    assert np.array_equal(batch.video[0], store.frames(0))  # 7 frames
    assert len(store.frames(4)) == 11
    assert np.array_equal(batch.video[1], store.frames(4)[[0, 2, 3, 5, 7, 8, 10]])


def test_a_beginning_of_at_most_the_share_given_is_left_out(store):
    rng = np.random.default_rng(0)
    sampling = Sampling(start_crop=0.5, goal_picture='recorded')
    batch = make_batch(store, [4] * 60, sampling, rng=rng)
    frames = store.frames(4)
    assert len(frames) == 11 and set(batch.end[:, 0].tolist()) == {5, 6, 7, 8, 9, 10}
    for b in range(60):
        start = 10 - batch.end[b, 0]  # the end, and so a recorded goal, stays
        assert np.array_equal(frames[start], batch.context[b, 0])
        assert np.array_equal(store[4].goal_frame, batch.context[b, 1])


def test_recorded_goals_stand_in_for_last_frames_where_they_were_reached(store):
    reached, unknown = store[0], np.full((2, 2), np.nan, np.float32)
    episodes = [
        reached,
        replace(reached, outcome='failure'),                                    # positions decide
        replace(reached, goal_pixels=reached.goal_pixels + np.float32([[0, 0], [3, 0]])),
        replace(reached, goal_pixels=unknown, outcome='success'),
        replace(reached, goal_pixels=unknown, outcome='failure')]
    expected = [True, True, False, True, False]
    assert [uses_recorded_goal(episode, 'recorded') for episode in episodes] == expected
    assert not any(uses_recorded_goal(episode, 'last') for episode in episodes)
    rng = np.random.default_rng(0)
    mixed = [uses_recorded_goal(reached, 'mixed', rng) for _ in range(200)]
    assert 70 < sum(mixed) < 130
    batch = make_batch(store, [0], Sampling(goal_picture='recorded'))
    assert np.array_equal(batch.context[0, 1], reached.goal_frame)


def test_each_pass_has_every_episode_once():
    steps = [episode_order(10, 4, seed=0, step=step) for step in range(5)]
    seen = np.concatenate(steps)
    assert sorted(seen[:10]) == list(range(10)) and sorted(seen[10:]) == list(range(10))
    assert not np.array_equal(seen[:10], seen[10:])


def test_augmentation_can_be_undone_and_is_the_same_for_all_pictures_of_an_episode():
    augmentation = Augmentation.draw(16, True, 0.3, np.random.default_rng(0))
    images = torch.rand(16, 2, 3, 8, 8) * 2 - 1
    changed = augmentation.apply(images)
    assert not changed.allclose(images)
    assert augmentation.undo(changed).allclose(images, atol=1e-5)
    assert augmentation.flip.any() and not augmentation.flip.all()
    changed = augmentation.apply(images[:, :1].expand(-1, 3, -1, -1, -1))
    assert changed[:, 0].equal(changed[:, 2])


def test_start_and_goal_are_drawn_around_the_label(store):
    labels = [int(n) // 2 for n in store.lengths]
    w = [np.full((1, int(n)), 0.1, np.float32) for n in store.lengths]
    for one, label in zip(w, labels):
        one[0, label] = 1
    episodes = np.arange(len(store))
    rng, pictures = np.random.default_rng(0), Pictures(preference=w)
    ends, whole = [], 0
    for _ in range(20):
        batch = make_batch(store, episodes, Sampling(around=2), rng, pictures)
        labelled = (batch.preference[:, 0] == 1) & batch.valid
        assert labelled.sum(1).tolist() == [1] * len(episodes), 'the label is a target'
        times = batch.times[labelled]
        assert (times >= 1).all() and (times < batch.end[:, 0]).all()
        whole += int((batch.end[:, 0].numpy() == store.lengths - 1).sum())
        ends.append(batch.end[:, 0].numpy())
    assert 0.2 < whole / (20 * len(episodes)) < 0.9 and np.std(ends, 0).max() > 0
