# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the pushing expert and of collecting: progress, variety, timing, resuming."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, run_episode
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError, StorageError, TapError
from tap_ros.base.files import only_writer
from tap_ros.recording.cache import open_recordings

SMALL = CollectConfig(episodes=3, episodes_per_file=1, seed=5, frames=12)


@pytest.fixture(scope='module')
def simulator():
    simulator = Simulator('push2', 64)
    yield simulator
    simulator.close()


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Return the folder of SMALL."""
    folder = tmp_path_factory.mktemp('whole') / 'push'
    collect(folder, SMALL, Engine(workers=1), progress=False)
    return folder


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def command(folder, config):
    """Return the command that collects it."""
    return [sys.executable, '-m', 'tap_ros', 'collect', '--out', str(folder), '--workers', '1',
            *(word for name in ('episodes', 'episodes_per_file', 'seed', 'frames')
              for word in ('--' + name.replace('_', '-'), str(getattr(config, name))))]


def test_the_expert_pushes_one_object_home_after_the_other(simulator):
    finals, firsts = [], set()
    for seed in range(4):
        observations, actions, _ = run_episode(simulator, seed)
        most = get_task('push2').num_frames
        assert len(actions) == len(observations) <= most
        assert np.abs(actions[0, :3]).max() > 0.005, 'the arm moves at once'
        places = np.array([o.object_poses[:, :3] for o in observations])
        if len(observations) < most:
            last = np.linalg.norm(places[-1] - places[-2], axis=-1).max()
            assert last > 1e-5, 'an object still moves at the end'
        finals.append(simulator.distances())
        touched = np.linalg.norm(places - places[0], axis=-1) > 0.01  # T, K
        firsts.add(touched.argmax(0).argmin())
    assert np.mean(finals) < 0.1, 'doing nothing ends at 0.2'
    assert firsts == {0, 1}


def bottleneck_share(episode):
    """Return when, from 0 to 1, one of two objects is home and the other untouched; else NaN."""
    pixels = episode.object_pixels
    to_start, to_goal = (np.linalg.norm(pixels - pixels[end], axis=-1) for end in (0, -1))
    scores = (to_start.sum(1, keepdims=True) - to_start + to_goal).min(1)
    return np.flatnonzero(scores <= 2).mean() / (len(scores) - 1) if scores.min() <= 2 else np.nan


def test_bottlenecks_come_early_or_late_as_asked(simulator):
    shares, outcomes = {}, []
    for timing in ('early', 'late'):
        found = [simulator.demonstrate(seed, timing=timing).episode
                 for seed in range(3)]
        shares[timing] = np.nanmedian([bottleneck_share(episode) for episode in found])
        outcomes += [episode.outcome == 'success' for episode in found]
    assert shares['early'] < 0.45 and shares['late'] > 0.7, 'without waiting 0.65'
    assert np.mean(outcomes) >= 0.7


def test_files_depend_on_nothing_but_the_settings(whole, tmp_path):
    """Not on the workers, nor on what was interrupted or damaged before."""
    collect(tmp_path / 'two' / 'push', SMALL, Engine(workers=2), progress=False)
    assert contents(tmp_path / 'two' / 'push') == contents(whole)
    assert [e.seed for e in open_recordings(whole)] == [5, 6, 7]
    folder = tmp_path / 'two' / 'push'
    (folder / 'push_0.mcap').rename(folder / 'push_0.mcap.part')
    (folder / 'push_1.mcap').write_bytes((whole / 'push_1.mcap').read_bytes()[:-1000])
    assert collect(folder, SMALL, Engine(workers=1), progress=False)['episodes'] == 2
    assert contents(folder) == contents(whole)


def test_what_was_killed_goes_on_to_the_same_files(whole, tmp_path):
    folder = tmp_path / 'push'
    process = subprocess.Popen(command(folder, SMALL), stderr=subprocess.DEVNULL)
    while not list(folder.glob('*.mcap*')) and process.poll() is None:
        time.sleep(0.02)
    children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
    worker, = (pid for pid in children
               if b'spawn_main' in Path(f'/proc/{pid}/cmdline').read_bytes())
    os.kill(int(worker), signal.SIGKILL)  # another takes its place
    while not list(folder.glob('*_0.mcap')) and process.poll() is None:
        time.sleep(0.02)
    process.kill()
    process.wait()
    collect(folder, SMALL, Engine(workers=1), progress=False)
    assert contents(folder) == contents(whole)


def test_an_interrupted_collection_says_how_it_goes_on(tmp_path):
    folder = tmp_path / 'push'
    many = CollectConfig(**vars(SMALL) | {'episodes': 500})  # not done before it is interrupted
    process = subprocess.Popen(command(folder, many), stderr=subprocess.PIPE, text=True)
    while not list(folder.glob('*.mcap*')) and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and 'the same command goes on' in said.splitlines()[-1]


def test_a_folder_is_never_mixed_with_other_settings(whole, tmp_path):
    before = contents(whole)
    for changes, named in (({'seed': 2}, 'seed'), ({'episodes': 2}, '3 episodes')):
        with pytest.raises(ConfigError, match=named):
            collect(whole, CollectConfig(**vars(SMALL) | changes), progress=False)
    with only_writer(tmp_path), pytest.raises(StorageError, match='another process'):
        collect(tmp_path, SMALL, progress=False)
    (tmp_path / 'collection.json').write_text('{"episodes": null}')
    with pytest.raises(ConfigError, match='collection.json: damaged.*remove it'):
        collect(tmp_path, SMALL, progress=False)
    for bad, words in (({'frames': 3}, 'frames.*10'), ({'task': 'juggle'}, 'juggle'),
                       ({'timing': 'late', 'task': 'grasp'}, 'grasp'), ({'misses': 1.5}, '1.5')):
        with pytest.raises(TapError, match=words):
            collect(tmp_path / 'bad', CollectConfig(**bad), progress=False)
    assert not (tmp_path / 'bad').exists() and contents(whole) == before


def test_pushes_at_random_miss(simulator):
    episode = simulator.demonstrate(4, misses=1.0).episode
    low = episode.grippers[:, 2] < 0.03
    moved = np.linalg.norm(np.diff(episode.object_pixels, axis=0), axis=-1).max(1)
    assert (low[:-1] & low[1:] & (moved < 0.05)).any(), 'low, and nothing moves'
    assert episode.outcome == 'failure'
