# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the split into training and held-out episodes."""

from pathlib import Path
from types import SimpleNamespace

from made_episodes import make_episode, write_bag
import numpy as np
import pytest
from tap_ros.base.errors import RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.training.forward_config import ForwardTrainingConfig
from tap_ros.training.run import bags_of
from tap_ros.training.split import split_episodes


class Store:
    """Episodes of which only the task, the seed, the length and the time are known."""

    marked = True

    def __init__(self, seeds, length=9, times=None):
        self._seeds, self.lengths = seeds, np.full(len(seeds), length)
        self._times = times or range(len(seeds))
        self.task = ['push2'] * len(seeds)

    def __len__(self):
        return len(self._seeds)

    def __getitem__(self, i):
        return SimpleNamespace(task=self.task[i], seed=self._seeds[i], stamps=self.seen(i))

    def seen(self, i):
        return 10 * self._times[i], 10 * self._times[i] + 8

    def source(self, i):
        return Path('bag/bag_0.mcap')


def test_split_is_complete_and_does_not_depend_on_what_else_there_is():
    training, held_out = split_episodes(Store(range(24)), 0.3)
    assert sorted([*training, *held_out]) == list(range(24))
    assert 0 < len(held_out) < len(training)
    assert split_episodes(Store(range(12)), 0.3)[1].tolist() == [i for i in held_out if i < 12]
    twice = split_episodes(Store([*range(24), *range(24)]), 0.3)
    assert {i % 24 for i in twice[0]}.isdisjoint(i % 24 for i in twice[1])


@pytest.mark.parametrize('times', [
    [i // 2 for i in range(24)], [*range(12)] * 3,
    [i + shift for shift in (0, 0.4) for i in range(12)]])  # that camera begins a little later
def test_cameras_of_one_demonstration_stay_on_one_side_without_seeds_too(times):
    for seed in (0, None):
        training, held_out = split_episodes(Store([seed] * len(times), times=times), 0.3)
        assert 0 < len(held_out) < len(training)
        assert {int(times[i]) for i in training}.isdisjoint(int(times[i]) for i in held_out)
    two_tasks = Store([0] * 12)
    two_tasks.task = ['push', 'pull'] * 6
    training, held_out = split_episodes(two_tasks, 0.3)
    assert {i % 2 for i in training} == {0, 1} and len(held_out)


def test_something_is_left_to_train_on_and_one_of_several_scenes_is_always_held_out():
    training, held_out = split_episodes(Store(range(3)), 1.0)
    assert training.tolist() == [0] and held_out.tolist() == [1, 2]
    for seeds in (range(2), range(20), [None] * 3):
        training, held_out = split_episodes(Store(seeds), 0.001)
        assert len(held_out) == 1 and len(training) == len(seeds) - 1
    assert not len(split_episodes(Store(range(20)), 0.0)[1])
    with pytest.raises(RecordingError, match='no episode has at least 100 frames'):
        split_episodes(Store(range(24)), 0.1, min_frames=100)


def test_recordings_that_are_named_are_held_out_wherever_they_are(tmp_path, monkeypatch):
    for number in range(3):
        write_bag(tmp_path / 'all' / f'bag{number}', [make_episode(number, start=(
            number + 1) * 10**10)])
    other = write_bag(tmp_path / 'other', [make_episode(7, start=10**12)])
    monkeypatch.chdir(tmp_path)

    def split(recordings, *held_out):
        bags = bags_of(ForwardTrainingConfig(
            recordings=tuple(recordings), held_out=held_out))
        store = open_recordings(bags, tmp_path / 'cache', progress=False)
        return [[store[i].seed for i in part]
                for part in split_episodes(store, 0.3, held_out=held_out)]

    assert split(['all'], 'all/bag1') == [[0, 2], [1]]
    assert split(['all'], str(tmp_path / 'all/bag1/bag1_0.mcap')) == [[0, 2], [1]]
    assert split(['all/bag0', 'all/bag1'], str(other)) == [[0, 1], [7]]
    assert split(['all', 'other'], 'all') == [[7], [0, 1, 2]]
    assert split(['other'], 'other') == [[], [7]]  # as an evaluation asks
