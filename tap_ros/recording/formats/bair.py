# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import the BAIR robot pushing data set from its TFRecord files into our recordings.

The given division is kept as two bags, train/ and test/ in the folder that is asked for, and a
file traj_256_to_511.tfrecords becomes train_256.mcap. The seed of an episode is the number of its
trajectory, in test/ plus 1 000 000, so that no two episodes share one when both bags are opened.

Of the two cameras of the 2017 data set the picture of image_aux1 is taken. There are no objects
and no goal pictures. What the records do not say, and how the recordings fill it:

- Times. Stamps are nominal, three frames a second: the scripts that the robot was run with spread
  the 30 frames over about ten seconds.
- The units of actions. The four numbers are written unchanged as dx, dy, dz and opening. The first
  two are a displacement; the last two seem to count the steps for which the gripper stays closed
  and lifted rather than to be metres and an opening, so these commands are not for another arm.
- The gripper's opening. It is NaN in /joint_states.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import math
from pathlib import Path
import re
from typing import Annotated, Any

import numpy as np
from tap_ros.errors import ImageError, RecordingError
from tap_ros.files import only_writer, storage_errors
from tap_ros.images.encodings import decompress
from tap_ros.options import Folder
from tap_ros.recording.episode import Episode
from tap_ros.recording.formats.tfrecord import parse_example, read_records
from tap_ros.recording.writer import EpisodeWriter, write_metadata
from tqdm import tqdm
from tyro import conf

FRAMES = 30
SIZE = (64, 64, 3)
CAMERAS = ('image_aux1', 'image_view0')  # the first that a record has
SEEDS = {'train': 0, 'test': 10**6}  # added to the number of the trajectory
PERIOD_NS = 10**9 // 3
EPISODE_SPACING_NS = 60 * 10**9  # between the starts of episodes
_NAME = re.compile(r'traj_(\d+)_to_(\d+)\.tfrecords')


@dataclass(frozen=True)
class Shard:
    """One file of the data set."""

    path: Path
    split: str  # 'train' or 'test'
    numbers: range  # of its trajectories

    def target(self, folder: str | Path) -> Path:
        """Return the path of the recording that it becomes."""
        return Path(folder, self.split, f'{self.split}_{self.numbers.start}.mcap')


def find_shards(paths: Iterable[str | Path]) -> list[Shard]:
    """
    Find the files of the data set, in the order of division and number.

    :param paths: files traj_<first>_to_<last>.tfrecords, or folders that hold some at any depth.
        The nearest folder above a file that is called train or test says what it is; without
        one it is training data.
    :return: list of Shard.
    :raises RecordingError: when there are none, one is called otherwise, or two overlap.
    """
    files = []
    for path in map(Path, paths):
        found = sorted(path.rglob('traj_*.tfrecords')) if path.is_dir() else [path]
        if not found:
            raise RecordingError(f'{path}: holds no file traj_<first>_to_<last>.tfrecords')
        files += found
    shards = sorted(map(_shard, files), key=lambda s: (s.split != 'train', s.numbers.start))
    for one, other in zip(shards, shards[1:]):
        if one.split == other.split and one.numbers.stop > other.numbers.start:
            raise RecordingError(
                f'{one.path} and {other.path} hold the same trajectories; name one of them only')
    return shards


def import_bair(paths: Iterable[str | Path], folder: str | Path, progress: bool = True) -> int:
    """
    Import files of the data set, or go on with an import that was interrupted.

    A file whose recording is there already is not read again.

    :param paths: see find_shards.
    :param folder: where the bags train/ and test/ are made.
    :param progress: show a progress bar.
    :return: number of episodes imported by this call.
    :raises RecordingError: at the first file that cannot be read or lacks something. What was
        imported before it stays, in complete bags.
    :raises StorageError: when the disk is full, or another process is importing there.
    """
    done = 0
    with only_writer(folder), storage_errors(folder):
        shards = find_shards(paths)
        missing = [shard for shard in shards if not shard.target(folder).exists()]
        with tqdm(total=sum(len(shard.numbers) for shard in missing), unit='episode',
                  disable=not progress) as bar:
            for shard in missing:
                target = shard.target(folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                _import_shard(shard, target, bar)
                write_metadata(target.parent)
                done += len(shard.numbers)
        for bag in {shard.target(folder).parent for shard in shards}:
            write_metadata(bag)  # a process that was killed may have left it behind its files
    return done


def read_episode(data: bytes, seed: int) -> Episode:
    """
    Decode one record.

    :param data: bytes of the tf.train.Example.
    :param seed: of the episode.
    :return: Episode of 30 frames of 64x64 pixels.
    :raises RecordingError: when something is missing or has another size; the message names it.
    """
    features = parse_example(data)
    camera = next((c for c in CAMERAS if f'0/{c}/encoded' in features), CAMERAS[0])
    if any(name.startswith(f'{FRAMES}/') for name in features):
        raise RecordingError(f'has more than {FRAMES} frames')
    times = range(FRAMES)
    frames = [_picture(features, f'{t}/{camera}/encoded') for t in times]
    positions = [_floats(features, f'{t}/endeffector_pos', 3) for t in times]
    actions = np.stack([_floats(features, f'{t}/action', 4) for t in times])
    actions[-1] = 0  # it leads to a frame that is not there
    return Episode(
        frames=np.stack(frames),
        stamps=(seed + 1) * EPISODE_SPACING_NS + np.arange(FRAMES, dtype=np.int64) * PERIOD_NS,
        actions=actions,
        grippers=np.insert(np.stack(positions), 3, np.nan, axis=1),
        object_names=(), object_pixels=np.zeros((FRAMES, 0, 2), np.float32),
        object_poses=np.zeros((FRAMES, 0, 7)), goal_frame=None,
        goal_pixels=np.zeros((0, 2), np.float32), goal_poses=np.zeros((0, 7)),
        object_source='imported', task='bair', seed=seed)


@dataclass(frozen=True)
class Options:
    """
    Options of `python -m tap_ros import-bair`.

    :param paths: the folder softmotion30_44k, or .tfrecords files of it.
    :param out: folder for the bags train and test, say bags/bair.
    """

    paths: Annotated[conf.Positional[tuple[str, ...]], conf.arg(
        metavar='PATH [PATH ...]', help_behavior_hint='(required)')]
    out: Folder


def run(args: Options) -> None:
    """Import and say what was imported."""
    count = import_bair(args.paths, args.out)
    if count:
        print(f'{args.out}: {count} episodes imported')
    else:
        print(f'{args.out}: all episodes were there already')


def _shard(path: Path) -> Shard:
    """Say what a file of the data set holds, by its name."""
    match = _NAME.fullmatch(path.name)
    numbers = range(int(match[1]), int(match[2]) + 1) if match else ()
    if not numbers or numbers.stop > SEEDS['test']:
        raise RecordingError(
            f'{path}: expected a file of the data set, traj_<first>_to_<last>.tfrecords')
    split = next((folder.name for folder in path.absolute().parents if folder.name in SEEDS),
                 'train')
    return Shard(path, split, numbers)


def _import_shard(shard: Shard, target: Path, bar: tqdm) -> None:
    """Import one file, wholly or not at all."""
    count, expected = 0, len(shard.numbers)
    with EpisodeWriter(target) as writer:
        for count, data in enumerate(read_records(shard.path), 1):
            if count > expected:
                break
            try:
                writer.write(read_episode(data, SEEDS[shard.split] + shard.numbers[count - 1]))
            except RecordingError as error:
                raise RecordingError(f'{shard.path}: record {count - 1}: {error}') from error
            bar.update()
        if count != expected:
            raise RecordingError(
                f'{shard.path}: by its name it holds {expected} records, but there are '
                f'{"more" if count > expected else count}; fetch the file again')


def _picture(features: Mapping[str, Any], name: str) -> np.ndarray:
    """Return a frame, (64, 64, 3) uint8 rgb."""
    value = features.get(name)
    if not isinstance(value, list) or len(value) != 1:
        raise RecordingError(f'lacks {name}; expected {FRAMES} frames of {" or ".join(CAMERAS)}')
    data, = value
    if len(data) == math.prod(SIZE):
        return np.frombuffer(data, np.uint8).reshape(SIZE)
    if not data.startswith((b'\xff\xd8\xff', b'\x89PNG')):
        raise RecordingError(f'{name} has {len(data)} bytes; expected 64 x 64 x 3')
    try:
        frame = decompress(data, 'unknown')  # copies of the data set are compressed
    except ImageError as error:
        raise RecordingError(f'{name} cannot be decoded: {error}') from error
    if frame.shape != SIZE:
        raise RecordingError(f'{name} is a picture of {frame.shape[1]}x{frame.shape[0]} pixels; '
                             'expected 64x64')
    return frame


def _floats(features: Mapping[str, Any], name: str, count: int) -> np.ndarray:
    """Return a vector, (count,) float32."""
    value = features.get(name)
    if not isinstance(value, np.ndarray) or value.shape != (count,):
        raise RecordingError(f'lacks {name}, or it is not {count} numbers')
    return value.astype(np.float32)
