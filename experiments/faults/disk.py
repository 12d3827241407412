# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Full disks: one clear line, an exit code that is not 0, and what was there stays readable."""

from contextlib import contextmanager
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

from experiments.faults.children import Reader, run_limited
from experiments.faults.fault import Fault
from experiments.faults.made_files import write_recording
from tap_ros.errors import TapError
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.recording.writer import write_metadata
from tap_ros.training.weights import load_tensors, save_weights

TIMEOUT_S = 180.0
EXPECTED_S = 20.0
OLD = 'old.safetensors'  # weights that were there before


@contextmanager
def small_disk(folder, size_bytes):
    """
    Give a folder that holds no more than so much, for the with-block.

    :param folder: made if it is not there.
    :param size_bytes: size of the file system.
    :return: the folder, or None where this user may not mount one.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    mounted = subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', f'size={size_bytes}', 'tmpfs', str(folder)],
        stderr=subprocess.DEVNULL).returncode == 0 if shutil.which('mount') else False
    try:
        yield folder if mounted else None
    finally:
        if mounted:
            subprocess.run(['umount', '-l', str(folder)], check=True)


def run_on_full_disk(folder, size_bytes, arguments, before=lambda folder: None):
    """
    Run `python -m tap_ros` with too little room.

    Where no file system can be mounted, no file of the run may grow beyond the size instead.

    :param folder: where the disk is to be.
    :param size_bytes: its size.
    :param arguments: words of the command, {} for the folder to write to.
    :param before: called with that folder first.
    :return: children.Ended, and the files left: {name: bytes}.
    """
    with small_disk(folder, size_bytes) as disk:
        place = disk or folder
        before(place)
        words = [word.replace('{}', str(place)) for word in arguments]
        ended = run_limited([sys.executable, '-m', 'tap_ros', *words], TIMEOUT_S,
                            None if disk else size_bytes)
        left = {str(path.relative_to(place)): path.read_bytes()
                for path in sorted(place.rglob('*')) if path.is_file()}
    return ended, left


def judge_ended(ended):
    """Say what is wrong with how a command ended; an empty string if nothing is."""
    errors = [line for line in ended.text.splitlines() if line.startswith('error: ')]
    if ended.code is None:
        return f'still ran after {TIMEOUT_S:.0f} s'
    if 'Traceback' in ended.text:
        return f'a traceback: {ended.text.strip().splitlines()[-1]}'
    if ended.code == 0:
        return 'exit code 0'
    if ended.code < 0:
        return f'ended by signal {-ended.code}'
    return '' if len(errors) == 1 else f'{len(errors)} error lines'


def collect(job):
    """Collect recordings until the disk is full, with a whole recording on it before."""
    for trial in job.trials():
        disk = job.folder / f'collect{trial}'
        size = int(job.random.integers(80_000, 400_000))

        def before(place):
            (place / 'old').mkdir()
            write_recording(place / 'old' / 'old_0.mcap', episodes=2, length=3)
            write_metadata(place / 'old')
        ended, left = run_on_full_disk(disk, size, [
            'collect', '--out', '{}/new', '--episodes', '30', '--episodes-per-file', '2',
            '--workers', '1', '--seed', str(trial)], before)
        why = judge_ended(ended) or _unreadable(job, left)
        job.record(not why, why, ended.seconds)


def train(job):
    """Train until the disk is full."""
    source = job.folder / 'source'
    source.mkdir()
    write_recording(source / 'source_0.mcap', episodes=8, length=8, size=64)
    write_metadata(source)
    network = Predictor(PredictorConfig(base_width=1))
    old = job.folder / OLD
    save_weights(old, network, 'predictor', network.config, {})
    for trial in job.trials():
        size = old.stat().st_size + int(job.random.integers(20_000, 400_000))
        ended, left = run_on_full_disk(job.folder / f'train{trial}', size, [
            'train', '--recordings', str(source), '--out', '{}', '--steps', '20', '--batch-size',
            '4', '--base-width', '4', '--save-every', '5'], lambda place: shutil.copy(old, place))
        why = judge_ended(ended) or _damaged_weights(left)
        litter = [name for name in left if name.endswith(('.part', '.tmp'))]
        if not why and litter:
            why = f'left behind: {", ".join(litter)}'
        job.record(not why, why, ended.seconds)


def _damaged_weights(left):
    """Say which weights of those left cannot be loaded; an empty string if all can."""
    if OLD not in left:
        return 'the weights that were there before are gone'
    with tempfile.TemporaryDirectory() as folder:
        for name, data in left.items():
            if name.endswith('.safetensors'):
                path = Path(folder) / Path(name).name
                path.write_bytes(data)
                try:
                    load_tensors(path)
                except TapError as error:
                    return f'what is left cannot be loaded: {error}'
    return ''


def _unreadable(job, left):
    """Say which recording of those left cannot be read; an empty string if all can."""
    place = job.folder / 'left'
    shutil.rmtree(place, ignore_errors=True)
    for name, data in left.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)
    with Reader() as reader:
        for folder in sorted({path.parent for path in place.rglob('*.mcap')}):
            found = reader.read('recording', folder)
            if found['error'] is not None:
                return f'what is left cannot be read: {found["error"]}'
            if folder.name == 'old' and (found['warnings'] or len(found['content']) != 2):
                return 'the recording that was there before is damaged'
    return ''


CLEAR = ('One line that says so and an exit code that is not 0; what was on the disk before, and '
         'every file that was finished, can be read.')
FAULTS = [
    Fault('disk-full-collect', 'the disk is full while recordings are collected', 'A long '
          'collection fills the disk over night.', CLEAR, 20, EXPECTED_S, collect,
          'until it ended', 's', 'median'),
    Fault('disk-full-train', 'the disk is full while weights are trained', 'A training cannot '
          'write its state or its weights.', CLEAR, 20, EXPECTED_S, train, 'until it ended', 's',
          'median')]
