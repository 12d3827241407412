# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the split into training and held-out episodes."""

from pathlib import Path
from types import SimpleNamespace

from made_episodes import make_episode, write_bag
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.training.forward_config import ForwardTrainingConfig
from tap_ros.training.run import bags_of
from tap_ros.training.split import describe_split, digests_of, split_as_trained, split_episodes

CRC32 = [3, 4, 5, 6, 7, 19, 29, 39, 49, 59]  # of 60 scenes, where 30% were asked for


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


def test_the_share_is_exact_and_few_change_sides_when_episodes_are_added():
    for count in range(2, 80):
        for seeds in (range(count), [0] * count):  # by scene, by demonstration
            training, held_out = split_episodes(Store(seeds), 0.3)
            assert sorted([*training, *held_out]) == list(range(count))
            assert len(held_out) == max(1, round(0.3 * count))
            more = split_episodes(Store([*seeds, seeds[-1] + (seeds[-1] > 0)]), 0.3)[1]
            assert len({*held_out} - {*more}) <= 1
    twice = split_episodes(Store([*range(24), *range(24)]), 0.3)
    assert {i % 24 for i in twice[0]}.isdisjoint(i % 24 for i in twice[1])
    drawn = np.array([split_episodes(Store(range(n, n + 40)), 0.3)[1] for n in range(0, 4000, 40)])
    assert 0.4 < drawn.mean() / 39 < 0.6  # early and late ones alike


def test_marked_demonstrations_are_held_out_only_when_no_others_are_left():
    for marked in (range(10), range(30, 40)):
        training, held_out = split_episodes(Store(range(40)), 0.5, marked=marked)
        assert len(held_out) == 20 and {*marked} <= {*training}
    held_out = split_episodes(Store(range(40)), 0.5, marked=range(1, 40))[1]
    assert len(held_out) == 20 and 0 in held_out
    cameras = Store([0] * 24, times=[i // 2 for i in range(24)])  # a mark in one of two cameras
    assert {0, 1, 2, 3} <= {*split_episodes(cameras, 0.8, marked=[0, 3])[0]}
    training, held_out = split_episodes(Store(range(40)), 0.5, marked=range(10))
    assert describe_split(held_out, training, range(10)).startswith(
        'held out: 20 of 40 episodes, none of 10 marked: 1')


def test_an_evaluation_finds_what_was_held_out_whatever_else_is_there():
    for seeds in (range(40), [0] * 40):
        store = Store(seeds, times=range(40))
        held_out = split_episodes(store, 0.3, marked=range(10))[1]
        digests = digests_of(store)
        training = {'held_out_digests': [digests[i] for i in held_out],
                    'settings': {'held_out': ()}}
        assert split_as_trained(store, training)[1].tolist() == held_out.tolist()
        part = Store(seeds[20:], times=range(20, 40))
        assert [i + 20 for i in split_as_trained(part, training)[1]] == [
            i for i in held_out if i >= 20]
        others = Store([*range(100, 120), *seeds], times=[*range(100, 120), *range(40)])
        if seeds[1]:
            assert [i - 20 for i in split_as_trained(others, training)[1]] == held_out.tolist()
    # Weights that do not tell were split by crc32.
    store = Store(range(200))
    assert split_as_trained(store, {'settings': {}}, 0.1)[1].tolist() == split_episodes(
        store, 0.1, split='crc32')[1].tolist() != split_as_trained(store, {}, 0.1)[1].tolist()


def test_the_shipped_weights_keep_their_split():
    held_out = split_episodes(Store(range(60)), 0.3, split='crc32', marked=range(60))[1]
    assert held_out.tolist() == CRC32
    assert split_episodes(Store(range(30)), 0.3, split='crc32')[1].tolist() == [
        i for i in held_out if i < 30]


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
    assert len(training) == 1 and len(held_out) == 2
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
    assert split(['all'], 'all:1') == split(['all'], 'all:1-1') == [[0, 2], [1]]
    assert split(['all'], 'all:0,2') == split(['all'], 'all/bag0', 'all/bag2:0') == [[1], [0, 2]]
    assert split(['all/bag0', 'all/bag1'], f'{other}:0') == [[0, 1], [7]]
    for wrong in ('all:3', 'all:0-99999999999', 'all:2-1'):
        with pytest.raises(ConfigError, match=f'--held-out {wrong}: there is no such'):
            split(['all'], wrong)
    for missing in ('none:1', 'all:x'):
        with pytest.raises(RecordingError, match='there is no such file'):
            split(['all'], missing)
    (tmp_path / 'all').rename(tmp_path / 'all:1')
    assert split(['all:1'], 'all:1') == [[], [0, 1, 2]]  # a folder of this name


def test_a_demonstration_that_is_named_is_held_out_with_all_its_cameras():
    store = Store([0] * 24, times=[*range(12)] * 2)
    training, held_out = split_episodes(store, held_out=['bag:3,5-6'])
    assert held_out.tolist() == [3, 5, 6, 15, 17, 18] and len(training) == 18
