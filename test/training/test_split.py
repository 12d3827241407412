# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the split into training and held-out episodes."""

from types import SimpleNamespace

import numpy as np
import pytest
from tap_ros.errors import RecordingError
from tap_ros.recording.episode import RecordingWarning
from tap_ros.training.split import split_episodes, warn_if_none


class Store:
    """Episodes of which only the task, the seed and the length are known."""

    def __init__(self, seeds, length=9):
        self._seeds, self.lengths = seeds, np.full(len(seeds), length)

    def __len__(self):
        return len(self._seeds)

    def __getitem__(self, i):
        return SimpleNamespace(task='push2', seed=self._seeds[i])


def test_split_is_complete_and_does_not_depend_on_what_else_there_is():
    training, held_out = split_episodes(Store(range(24)), 0.3)
    assert sorted([*training, *held_out]) == list(range(24))
    assert 0 < len(held_out) < len(training)
    assert split_episodes(Store(range(12)), 0.3)[1].tolist() == [i for i in held_out if i < 12]


def test_episodes_of_the_same_scene_land_on_the_same_side():
    training, held_out = split_episodes(Store([*range(24), *range(24)]), 0.3)
    assert {i % 24 for i in training}.isdisjoint(i % 24 for i in held_out)


def test_recordings_without_seeds_are_split_by_position():
    training, held_out = split_episodes(Store([None] * 24), 0.3)
    assert 0 < len(held_out) < len(training)


def test_something_is_left_to_train_on():
    training, held_out = split_episodes(Store(range(3)), 1.0)
    assert training.tolist() == [0] and held_out.tolist() == [1, 2]


def test_one_of_several_scenes_is_always_held_out():
    for seeds in (range(2), range(20), [None] * 3):
        training, held_out = split_episodes(Store(seeds), 0.001)
        assert len(held_out) == 1 and len(training) == len(seeds) - 1
    training, held_out = split_episodes(Store([5, 8, 5, 8]), 0.001)
    assert len(held_out) == 2 and {i % 2 for i in training}.isdisjoint(i % 2 for i in held_out)
    assert not len(split_episodes(Store(range(20)), 0.0)[1])


def test_a_lone_episode_is_trained_on_and_a_warning_says_so():
    training, held_out = split_episodes(Store([7]), 0.05)
    assert training.tolist() == [0] and not len(held_out)
    with pytest.warns(RecordingWarning, match='no episode is held out'):
        warn_if_none(held_out)


def test_nothing_to_train_on_is_said():
    with pytest.raises(RecordingError, match='no episode has at least 100 frames'):
        split_episodes(Store(range(24)), 0.1, min_frames=100)
