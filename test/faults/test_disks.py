# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Full disks: one clear line, an exit code that is not 0, and what was there stays readable."""

from contextlib import contextmanager
import shutil
import statistics
import subprocess
import sys
import time
import warnings

from fault_report import fault
from made_episodes import make_episode
import numpy as np
import pytest
from tap_ros.base.errors import TapError
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.writer import EpisodeWriter, write_metadata
from tap_ros.weights.weights import load_tensors, save_weights

TIMEOUT_S = 180.0
FULL = 'the disk is full while recordings are collected or weights trained'
CLEAR = 'one line that says so, exit code not 0; finished files can be read'


@contextmanager
def small_disk(folder, size_bytes):
    """
    Give a folder that holds no more than so much, for the with-block.

    :param folder: made if it is not there.
    :param size_bytes: size of the file system.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not shutil.which('mount') or subprocess.run(
            ['mount', '-t', 'tmpfs', '-o', f'size={size_bytes}', 'tmpfs', str(folder)],
            stderr=subprocess.DEVNULL).returncode:
        pytest.skip('no file system may be mounted here; try as root')
    try:
        yield
    finally:
        subprocess.run(['umount', '-l', str(folder)], check=True)


def run_on_full_disk(*words):
    """Run `python -m tap_ros`; raise AssertionError unless it says what is wrong; return s."""
    begin = time.monotonic()
    ended = subprocess.run(
        ['timeout', '--kill-after=1', str(TIMEOUT_S), sys.executable, '-m', 'tap_ros',
         *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert ended.returncode not in (124, 137), f'still ran after {TIMEOUT_S:.0f} s'
    lines = ended.stdout.strip().splitlines()
    assert 'Traceback' not in ended.stdout, f'a traceback: {lines[-1]}'
    assert ended.returncode > 0, f'exit code {ended.returncode}'
    errors = [line for line in lines if line.startswith('error: ')]
    assert len(errors) == 1, f'{len(errors)} error lines'
    return time.monotonic() - begin


@pytest.mark.parametrize('what', [
    pytest.param(what, id=f'disk-full-{what}', marks=fault(
        FULL, CLEAR, 8, 's until it ended (median)', statistics.median))
    for what in ('collect', 'train')])
def test_(trials, tmp_path, what):
    random, source = np.random.default_rng(0), tmp_path / 'source'
    write_bag(source, episodes=8, length=8, size=64)
    network, old = PredictorNetwork(PredictorConfig(base_width=1)), tmp_path / 'old.safetensors'
    save_weights(old, network, 'predictor', network.config, {})
    for trial in trials:
        disk = tmp_path / f'disk{trial}'
        size = old.stat().st_size + int(random.integers(80_000, 400_000))
        with trials.one(), small_disk(disk, size):
            shutil.copy(old, disk)
            write_bag(disk / 'old', episodes=2, length=3)
            trials.measured(run_on_full_disk(*(
                ('collect', '--out', disk / 'new', '--episodes', 30, '--episodes-per-file', 2,
                 '--workers', 1, '--seed', trial) if what == 'collect' else
                ('train', 'predictor', source, '--out', disk, '--steps', 20,
                 '--batch-size', 4, '--base-width', 4, '--save-every', 5))))
            assert (disk / old.name).exists(), 'the weights that were there before are gone'
            for path in disk.rglob('*.safetensors'):
                load_tensors(path)
            for folder in sorted({path.parent for path in disk.rglob('*.mcap')}):
                episodes, told = read_bag(folder)
                assert folder.name != 'old' or (len(episodes) == 2 and not told), (
                    'the recording that was there before is damaged')
            litter = [*disk.rglob('*.part'), *disk.rglob('*.tmp')]
            assert not litter, f'left behind: {litter}'


def write_bag(folder, episodes, length, size=16):
    """Write a recording of pictures of a width and height."""
    folder.mkdir()
    with EpisodeWriter(folder / f'{folder.name}_0.mcap') as writer:
        for seed in range(episodes):
            writer.write(make_episode(seed, length, size=(size, size), start=(seed + 1) * 10**10))
    write_metadata(folder)


def read_bag(folder):
    """Return the episodes of what is left, and the warnings; raise TapError for none."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter('always')
        return list(open_recordings(folder)), told


@pytest.mark.ros
@pytest.mark.errors('cannot be written|No space left')
@fault('the disk is full while recorder_node records', 'error in log and answer, exit code not 0; '
       'what was recorded can be read', 8)
def test_disk_full_recorder(trials, rig, tmp_path):
    random = np.random.default_rng(0)
    rig.need()
    for trial in trials:
        disk = tmp_path / f'disk{trial}'
        with trials.one(), small_disk(disk, int(random.integers(400_000, 1_200_000))):
            node = rig.start('recorder_node', folder=disk / 'bag', compression='none')
            node.wait_for('ready')
            with rig.world(30.0):
                deadline = time.monotonic() + 30
                while '[ERROR]' not in node.text:
                    assert time.monotonic() < deadline, 'no error in the log'
                    time.sleep(0.1)
                fill(disk / 'rest')
                with pytest.raises(TapError, match='refused'):
                    rig.client.record()
            assert node.alive, f'it ended: {node.last_line()}'
            assert node.end(), 'exit code 0 though the recording is not whole'
            assert 'Traceback' not in node.text, 'a traceback'
            read_bag(disk / 'bag')
        rig.remove('recorder_node')


def fill(path):
    """Take what room is left."""
    with path.open('wb', buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            pass
