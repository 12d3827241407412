# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of timing: bottlenecks come when they are asked for, and nothing is moved in time."""

import json

import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig, make_episode
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.push import draw_share, SHARES
from sim_bridge.tasks.tasks import run_episode, TIMINGS
from tap_ros.errors import ConfigError
from tap_ros.evaluation.bottleneck import bottleneck_share
from tap_ros.recording.reader import iter_episodes

SEEDS = range(5)


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2')
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def episodes(simulator):
    """Return {timing: Episodes}."""
    return {timing: [make_episode(simulator, *run_episode(simulator, seed, timing=timing)[:3])
                     for seed in SEEDS] for timing in ('early', 'late')}


def test_bottlenecks_come_early_or_late_as_asked(episodes):
    early, late = (np.nanmedian([bottleneck_share(episode) for episode in episodes[timing]])
                   for timing in ('early', 'late'))
    assert early < 0.45 and late > 0.7, 'without waiting 0.65'


def test_most_timed_episodes_finish(episodes):
    outcomes = [episode.outcome for found in episodes.values() for episode in found]
    assert np.mean([outcome == 'success' for outcome in outcomes]) >= 0.7


def test_the_actions_of_timed_episodes_lead_to_their_frames(simulator, episodes):
    for found in episodes.values():
        episode = found[0]
        frames = [simulator.reset(episode.seed).image]
        frames += [simulator.step(action).image for action in episode.actions[:-1]]
        # Actions are recorded in single precision.
        differ = np.mean([(a != b).any(-1).mean() for a, b in zip(frames, episode.frames)])
        assert differ < 0.01


def test_shares_are_drawn_within_their_ranges():
    rng = np.random.default_rng(0)
    for timing, (low, high) in SHARES.items():
        shares = [draw_share(timing, rng) for _ in range(50)]
        assert low <= min(shares) < max(shares) <= high
    mixed = np.array([draw_share('mixed', rng) for _ in range(100)])
    assert all(((low <= mixed) & (mixed <= high)).mean() > 0.2 for low, high in SHARES.values())


def test_frames_and_timing_are_kept_beside_the_recording(tmp_path):
    usual, late = tmp_path / 'usual', tmp_path / 'late'
    collect(usual, CollectConfig(episodes=1, seed=4), progress=False)
    kept = json.loads((usual / 'collection.json').read_text())
    assert (kept['frames'], kept['timing']) == (0, 'natural')
    with pytest.raises(ConfigError, match='frames'):
        collect(usual, CollectConfig(episodes=1, seed=4, frames=20), progress=False)
    config = CollectConfig(episodes=1, seed=4, frames=20, timing='late')
    collect(late, config, progress=False)
    kept = json.loads((late / 'collection.json').read_text())
    assert (kept['frames'], kept['timing']) == (20, 'late')
    episode, = iter_episodes(late)
    assert len(episode.frames) <= 20
    for other in (CollectConfig(episodes=1, seed=4, timing='late'),
                  CollectConfig(episodes=1, seed=4, frames=20)):
        with pytest.raises(ConfigError, match='other settings'):
            collect(late, other, progress=False)


def test_longer_episodes_begin_as_the_usual_ones(simulator):
    seed = 3  # of an episode that is cut off at the usual length
    usual, longer = (run_episode(simulator, seed, num_frames=n) for n in (0, 70))
    assert len(usual[0]) == simulator.task.num_frames < len(longer[0]) <= 70
    np.testing.assert_array_equal(usual[1][:20], longer[1][:20])
    assert longer[2] == 'success'


@pytest.mark.parametrize(('changes', 'named'), [
    ({'timing': 'soon'}, ['soon', *TIMINGS]), ({'timing': 'late', 'task': 'grasp'}, ['grasp']),
    ({'frames': 3}, ['frames is 3', '10']), ({'frames': 5000}, ['5000', '1000'])])
def test_impossible_settings_are_refused_by_name(tmp_path, changes, named):
    with pytest.raises(ConfigError) as error:
        collect(tmp_path / 'bag', CollectConfig(episodes=1, **changes), progress=False)
    assert all(word in str(error.value) for word in named)
    assert not (tmp_path / 'bag').exists()
