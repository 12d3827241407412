# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the expert and of collecting: progress, variety, reproducibility, resuming."""

import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.expert import run_episode
from sim_bridge.simulator import Simulator
from tap_ros.errors import ConfigError
from tap_ros.recording.reader import iter_episodes


@pytest.fixture(scope='module')
def episodes():
    simulator = Simulator('push2')
    found = []
    for seed in range(8):
        observations, actions, outcome, _ = run_episode(simulator, seed)
        found.append((observations, actions, outcome, simulator.distances()))
    simulator.close()
    return found


def test_the_expert_pushes_objects_to_their_goals(episodes):
    final = np.mean([distances for *_, distances in episodes])
    assert final < 0.1, 'doing nothing ends at 0.2'


def test_no_episode_ends_idle_or_is_too_long(episodes):
    for observations, actions, _, _ in episodes:
        assert len(actions) == len(observations) <= 40
        positions = np.array([o.object_poses[:, :3] for o in observations])
        assert np.abs(actions[0, :3]).max() > 0.005, 'the arm moves at once'
        if len(observations) < 40:
            last = np.linalg.norm(positions[-1] - positions[-2], axis=-1).max()
            assert last > 1e-5, 'an object still moves at the end'


def test_the_order_of_objects_varies(episodes):
    first = set()
    for observations, *_ in episodes:
        positions = np.array([o.object_poses[:, :2] for o in observations])
        moved = np.linalg.norm(positions - positions[0], axis=-1) > 0.02  # (T, K)
        first.add(int(moved.argmax(0).argmin()))
    assert first == {0, 1}


def test_files_do_not_depend_on_the_number_of_workers(tmp_path):
    config = CollectConfig(episodes=4, episodes_per_file=2, seed=11)
    for workers in (1, 2):
        collect(tmp_path / str(workers) / 'push', config, workers=workers, progress=False)
    for name in ('push_0.mcap', 'push_1.mcap', 'metadata.yaml'):
        a, b = ((tmp_path / w / 'push' / name).read_bytes() for w in '12')
        assert a == b, name
    assert [e.seed for e in iter_episodes(tmp_path / '1' / 'push')] == [11, 12, 13, 14]


def test_an_interrupted_collection_goes_on_to_the_same_files(tmp_path):
    config = CollectConfig(episodes=2, episodes_per_file=1, seed=5)
    folder = tmp_path / 'push'
    collect(folder, config, progress=False)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    (folder / 'push_1.mcap').rename(folder / 'push_1.mcap.part')
    assert collect(folder, config, progress=False)['episodes'] == 1
    assert {p.name: p.read_bytes() for p in folder.glob('*.mcap')} == {
        name: data for name, data in before.items() if name.endswith('.mcap')}


def test_a_folder_is_never_mixed_with_other_settings(tmp_path):
    folder = tmp_path / 'push'
    collect(folder, CollectConfig(episodes=1, seed=1), progress=False)
    before = (folder / 'push_0.mcap').read_bytes()
    with pytest.raises(ConfigError, match='seed'):
        collect(folder, CollectConfig(episodes=1, seed=2), progress=False)
    assert (folder / 'push_0.mcap').read_bytes() == before
