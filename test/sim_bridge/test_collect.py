# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the expert and of collecting: progress, variety, reproducibility, resuming."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from experiments.paper.places import is_collected
import numpy as np
import pytest
from sim_bridge.collect import collect, CollectConfig
from sim_bridge.simulator import Simulator
from sim_bridge.tasks.tasks import get_task, run_episode
from tap_ros.engines import Engine
from tap_ros.errors import ConfigError, StorageError
from tap_ros.files import only_writer
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
        assert len(actions) == len(observations) <= get_task('push2').num_frames
        positions = np.array([o.object_poses[:, :3] for o in observations])
        assert np.abs(actions[0, :3]).max() > 0.005, 'the arm moves at once'
        if len(observations) < get_task('push2').num_frames:
            last = np.linalg.norm(positions[-1] - positions[-2], axis=-1).max()
            assert last > 1e-5, 'an object still moves at the end'


def test_the_order_of_objects_varies(episodes):
    first = set()
    for observations, *_ in episodes:
        positions = np.array([o.object_poses[:, :2] for o in observations])
        moved = np.linalg.norm(positions - positions[0], axis=-1) > 0.02  # (T, K)
        first.add(int(moved.argmax(0).argmin()))
    assert first == {0, 1}


def test_the_first_object_is_home_before_the_next_is_touched():
    """Else no frame shows the bottleneck; in this scene the first push ends short."""
    simulator = Simulator('push2')
    observations = run_episode(simulator, 12)[0]
    places = np.array([observation.object_poses[:, :3] for observation in observations])
    touched = np.linalg.norm(places - places[0], axis=-1) > 0.01  # T, K
    first, second = np.argsort(touched.argmax(0))
    gaps = np.linalg.norm(places - simulator.goal().object_poses[:, :3], axis=-1)
    assert gaps[touched[:, second].argmax() - 1, first] < 0.025
    simulator.close()


def test_files_do_not_depend_on_the_number_of_workers(tmp_path):
    config = CollectConfig(episodes=4, episodes_per_file=2, seed=11)
    for workers in (1, 2):
        collect(tmp_path / str(workers) / 'push', config, Engine(workers=workers), progress=False)
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


@pytest.mark.slow
def test_files_do_not_depend_on_the_engine(tmp_path, monkeypatch):
    pytest.importorskip('ray')
    monkeypatch.setenv('RAY_ADDRESS', '127.0.0.1:1')  # a cluster that was not asked for
    config = CollectConfig(episodes=3, episodes_per_file=1, seed=11)
    for name in ('local', 'ray'):
        collect(tmp_path / name / 'push', config, Engine(name), progress=False)
    assert contents(tmp_path / 'ray' / 'push') == contents(tmp_path / 'local' / 'push')


def test_the_file_of_a_killed_worker_is_collected_again(tmp_path):
    config = CollectConfig(episodes=4, episodes_per_file=2, seed=5)
    collect(tmp_path / 'whole' / 'push', config, progress=False)
    folder = tmp_path / 'killed' / 'push'
    process = subprocess.Popen(
        [sys.executable, '-m', 'tap_ros', 'collect', '--out', str(folder), '--episodes', '4',
         '--episodes-per-file', '2', '--seed', '5', '--workers', '1'], stderr=subprocess.DEVNULL)
    while not list(folder.glob('*.mcap.part')) and process.poll() is None:
        time.sleep(0.02)
    children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
    worker, = (pid for pid in children
               if b'spawn_main' in Path(f'/proc/{pid}/cmdline').read_bytes())
    os.kill(int(worker), signal.SIGKILL)
    assert process.wait() == 0
    assert contents(folder) == contents(tmp_path / 'whole' / 'push')


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_killed_collection_goes_on_to_the_same_files(tmp_path):
    config = CollectConfig(episodes=4, episodes_per_file=1, seed=5)
    collect(tmp_path / 'whole' / 'push', config, progress=False)
    folder = tmp_path / 'killed' / 'push'
    process = subprocess.Popen(
        [sys.executable, '-m', 'tap_ros', 'collect', '--out', str(folder), '--episodes', '4',
         '--episodes-per-file', '1', '--seed', '5'], stderr=subprocess.DEVNULL)
    while not list(folder.glob('*.mcap')) and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    collect(folder, config, progress=False)
    assert contents(folder) == contents(tmp_path / 'whole' / 'push')


def test_a_full_disk_is_one_line_and_what_was_there_stays(tmp_path):
    folder = tmp_path / 'push'
    collect(folder, CollectConfig(episodes=1, episodes_per_file=4, seed=5), progress=False)
    before = contents(folder)
    # no file may grow larger than the one that is there
    limit = (f'import resource, sys; from tap_ros.cli import main; '
             f'resource.setrlimit(resource.RLIMIT_FSIZE, ({len(before["push_0.mcap"])},) * 2); '
             'sys.exit(main(sys.argv[1:]))')
    ended = subprocess.run(
        [sys.executable, '-c', limit, 'collect', '--out', str(folder), '--episodes', '4',
         '--episodes-per-file', '4', '--seed', '5'], capture_output=True, text=True)
    assert ended.returncode == 1 and 'Traceback' not in ended.stderr, ended.stderr
    assert ended.stderr.splitlines()[-1].startswith(f'error: {folder}')
    assert contents(folder) | {'collection.json': b''} == before | {'collection.json': b''}
    assert [e.seed for e in iter_episodes(folder)] == [5]
    assert not is_collected(folder, 4)
    collect(folder, CollectConfig(episodes=4, episodes_per_file=4, seed=5), progress=False)
    assert [e.seed for e in iter_episodes(folder)] == [5, 6, 7, 8] and is_collected(folder, 4)


def test_a_second_collection_into_the_same_folder_is_refused(tmp_path):
    with only_writer(tmp_path), pytest.raises(StorageError, match='another process'):
        collect(tmp_path, CollectConfig(episodes=1), progress=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('text', ['', '{"task": ', '[]', '3', '{"episodes": null}', '[' * 10 ** 5])
def test_damaged_settings_are_named_with_the_remedy(tmp_path, text):
    Path(tmp_path, 'collection.json').write_text(text)
    with pytest.raises(ConfigError, match='collection.json: damaged.*remove it') as error:
        collect(tmp_path, CollectConfig(episodes=1), progress=False)
    assert str(error.value).isprintable()
    assert Path(tmp_path, 'collection.json').read_text() == text


def test_a_damaged_file_is_made_anew(tmp_path):
    folder, config = tmp_path / 'push', CollectConfig(episodes=2, episodes_per_file=1, seed=5)
    collect(folder, config, progress=False)
    before = contents(folder)
    (folder / 'push_1.mcap').write_bytes(before['push_1.mcap'][:-1000])
    assert collect(folder, config, progress=False)['episodes'] == 1
    assert contents(folder) == before
    assert json.loads(before['collection.json'])['episodes'] == 2


def test_a_recording_from_before_there_were_looks_is_not_gone_on_with_in_another(tmp_path):
    folder = tmp_path / 'bag'
    config = CollectConfig(task='grasp', episodes=1)
    collect(folder, config, progress=False)
    path = folder / 'collection.json'
    settings = json.loads(path.read_text())
    for name in ('look', 'appearance', 'frames', 'timing', 'misses'):
        del settings[name]
    path.write_text(json.dumps(settings))
    with pytest.raises(ConfigError, match=r'other settings \(look\)'):
        collect(folder, config, progress=False)


def test_pushes_at_random_miss_and_are_repeated_exactly(tmp_path):
    episodes = {}
    for name, misses in (('a', 1.0), ('b', 1.0), ('expert', 0.0)):
        config = CollectConfig(episodes=2, seed=4, misses=misses)
        collect(tmp_path / name, config, progress=False)
        episodes[name] = list(iter_episodes(tmp_path / name))
    for a, b in zip(episodes['a'], episodes['b']):
        assert np.array_equal(a.actions, b.actions)
    low = [e.grippers[:, 2] < 0.03 for e in episodes['a']]
    still = [np.linalg.norm(np.diff(e.object_pixels, axis=0), axis=-1).max(1) < 0.05
             for e in episodes['a']]
    missed = sum((a[:-1] & a[1:] & b).sum() for a, b in zip(low, still))
    assert missed > 5, 'low, and nothing moves'
    assert all(e.outcome == 'failure' for e in episodes['a'])
    for bad, words in (({'misses': 1.5}, 'misses is 1.5'),
                       ({'misses': 0.5, 'task': 'grasp'}, 'grasp')):
        with pytest.raises(ConfigError, match=words):
            collect(tmp_path / 'bad', CollectConfig(episodes=1, **bad), progress=False)
