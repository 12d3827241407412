# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings as memory maps: decoded once, kept in a cache, then read at the speed of memory.

Each MCAP file has a folder in the cache, named after the SHA-256 of its content, with the frames
as one uint8 array, the robot masks as another, and all else as columns. Any number of processes
may build and read it at once.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
import hashlib
import json
import multiprocessing
import os
from pathlib import Path
import shutil
import tempfile
import threading
from typing import BinaryIO

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from tap_ros.errors import RecordingError
from tap_ros.recording.align import assemble, EpisodeTable, follows
from tap_ros.recording.bags import check_sizes, find_bags, find_topics, list_paths, warn_of_damage
from tap_ros.recording.columns import Columns, decode_file
from tap_ros.recording.episode import Episode
from tap_ros.recording.mounts import ArmMount, read_mount
from tap_ros.recording.reading import AS_RECORDED, for_bags, Reading
from tqdm import tqdm

FORMAT = 4  # of a cache folder; another number makes all files be decoded again
ENVIRONMENT = 'TAP_ROS_CACHE'
_ALONE_BYTES = 2**24  # of files that are decoded before other processes would have started
_NPY_HEADER = 128  # bytes kept free for the header of frames.npy, which is known last
_PARSING = threading.Lock()
_GOALS = ('goal_frames', 'goal_masks')  # of Columns, kept among the arrays


class EpisodeStore:
    """
    Episodes of recordings, in their order, as views of memory maps.

    :param tables: list of EpisodeTable.
    :param file_hashes: hex digests of the files, in order, and what else tells them apart.
    :ivar image_size: (height, width) of the frames.
    :ivar camera_size: likewise, as they were recorded; None where that differs.
    :ivar marked: whether marks tell episodes apart, in some of the recordings at least.
    """

    def __init__(self, tables: Sequence[EpisodeTable], file_hashes: Iterable[str]) -> None:
        self._index = [(table, i) for table in tables for i in range(len(table))]
        lengths = [np.diff(table.starts) for table in tables]
        self.lengths = np.concatenate([np.empty(0, np.int64), *lengths])  # (E,) frames
        self.num_frames = int(self.lengths.sum())
        self.image_size = next(
            part.image_size for table in tables for part in table.parts if part.image_size)
        cameras = {part.camera_size for table in tables for part in table.parts
                   if part.camera_size}
        self.camera_size = cameras.pop() if len(cameras) == 1 else None
        self.marked = any(part.marks for table in tables for part in table.parts)
        self.data_hash = hashlib.sha256(''.join(file_hashes).encode()).hexdigest()

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._index)

    def __getitem__(self, i: int) -> Episode:
        """Return Episode i."""
        table, local = self._index[i]
        return table.episode(local)

    def frames(self, i: int) -> np.ndarray:
        """Return the frames of episode i, (T, H, W, 3) uint8."""
        table, local = self._index[i]
        return table.frames(local)

    def has_masks(self, i: int) -> bool:
        """Tell whether every frame of episode i has a robot mask."""
        table, local = self._index[i]
        return table.has_masks(local)


def open_recordings(paths: str | Path | Iterable[str | Path], cache_dir: str | Path | None = None,
                    progress: bool = True, reading: Reading = AS_RECORDED) -> EpisodeStore:
    """
    Open recordings, decoding what is not in the cache yet.

    :param paths: one or a list of .mcap files, bag folders, or folders of bag folders.
    :param cache_dir: by default $TAP_ROS_CACHE or ~/.cache/tap_ros.
    :param progress: show a progress bar when decoding takes long.
    :param reading: Reading: which pictures, which part of them, and where episodes are cut.
    :return: EpisodeStore.
    :raises RecordingError: when a recording is missing, empty, damaged or lacks the image topic,
        or when the images differ in size; the message names the file.
    """
    paths = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    bags = [bag for path in paths for bag in find_bags(path)]
    cache_dir = Path(cache_dir) if cache_dir else cache_folder()
    with tqdm(total=sum(file.stat().st_size for bag in bags for file in bag),
              desc='opening recordings', unit='B', unit_scale=True, disable=not progress,
              delay=1) as bar:
        jobs = _jobs(bags, [find_topics(bag, reading.image_topic) for bag in bags], reading,
                     cache_dir)
        loaded = {job: _load(job.folder, job.path) for bag in jobs for job in bag}
        bar.update(sum(job.size for job, part in loaded.items() if part is not None))
        missing = [job for job, part in loaded.items() if part is None]
        for job in _built(missing):
            bar.update(job.size)
        loaded |= {job: _load(job.folder, job.path) for job in missing}
    unread = next((job.folder for job, part in loaded.items() if part is None), None)
    if unread is not None:
        raise RecordingError(f'{unread}: the cache cannot be read back; is the disk full?')
    columns = [[part for job in bag if (part := loaded[job]) is not None] for bag in jobs]
    check_sizes([part for bag in columns for part in bag])
    for part in (part for bag in columns for part in bag):
        warn_of_damage(part)
    arms = [read_mount(bag[0].parent) for bag in bags]
    cutting = for_bags(reading, len(bags))
    tables = [
        assemble(run, arm, cutting) for bag, arm in zip(columns, arms) for run in _runs(bag)]
    # What is read depends on these, too.
    apart = [repr(arm) for arm in arms if arm != ArmMount()]
    if replace(reading, image_topic='') != AS_RECORDED:
        apart.append(repr(replace(reading, image_topic='')))
    store = EpisodeStore(tables, [*(job.digest for bag in jobs for job in bag), *apart])
    if not len(store):
        raise RecordingError(f'{list_paths(paths)}: no camera image lies within an episode')
    return store


def cache_folder() -> Path:
    """Return the folder of the cache: $TAP_ROS_CACHE or ~/.cache/tap_ros."""
    return Path(os.environ.get(ENVIRONMENT) or '~/.cache/tap_ros').expanduser()


@dataclass(frozen=True)
class _Job:
    """A file to be opened."""

    path: Path
    size: int
    digest: str
    found: tuple[tuple[str, str], ...]  # pairs of a name in topics and the file's topic
    reading: Reading
    folder: Path  # of the cache


def _jobs(bags: Sequence[Sequence[Path]], found: Sequence[Mapping[str, str]], reading: Reading,
          cache_dir: Path) -> list[list[_Job]]:
    """Return a list of _Job for each bag."""
    def job(path: Path, names: Mapping[str, str]) -> _Job:
        with open(path, 'rb') as stream:
            digest = hashlib.file_digest(stream, 'sha256').hexdigest()
        key = hashlib.sha256(json.dumps([
            FORMAT, sorted(names.items()), reading.crop, reading.size, reading.rate,
        ]).encode()).hexdigest()[:8]
        return _Job(path, path.stat().st_size, digest, tuple(names.items()), reading,
                    cache_dir / f'{digest}-{key}')
    with ThreadPoolExecutor(_workers()) as pool:
        waiting = [[pool.submit(job, path, names) for path in bag]
                   for bag, names in zip(bags, found, strict=True)]
        return [[task.result() for task in bag] for bag in waiting]


def _workers() -> int:
    """Return the number of files decoded at once."""
    return len(os.sched_getaffinity(0))


def _built(jobs: Iterable[_Job]) -> Iterator[_Job]:
    """
    Decode files into their cache folders; yield the jobs that are done.

    Decoding is Python and holds its lock, so that processes do it where there is much to do.
    """
    left = list(jobs)
    workers = min(_workers(), len(left))
    if (workers > 1 and sum(job.size for job in left) > _ALONE_BYTES
            and not multiprocessing.current_process().daemon):  # which may not have children
        with ProcessPoolExecutor(workers, multiprocessing.get_context('spawn')) as pool:
            try:
                tasks = {pool.submit(_build, job): job for job in left}
                for task in as_completed(tasks):
                    task.result()
                    left.remove(tasks[task])
                    yield tasks[task]
            except BrokenProcessPool:  # one was killed, or cannot import the user's script
                pass
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    for job in left:
        _build(job)
        yield job


def _runs(parts: Iterable[Columns]) -> list[list[Columns]]:
    """Split the files of a bag where one does not go on where the one before ended."""
    runs: list[list[Columns]] = []
    for part in parts:
        if runs and follows(runs[-1][-1], part):
            runs[-1].append(part)
        else:
            runs.append([part])
    return runs


def _build(job: _Job) -> None:
    """Decode a file into its cache folder, which appears complete or not at all."""
    path, folder = job.path, job.folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=folder.name + '.', dir=folder.parent))
    except OSError as error:
        raise RecordingError(
            f'{folder.parent}: the cache cannot be written ({error.strerror}); set {ENVIRONMENT} '
            'to a folder that can') from error
    try:
        with open(part / 'frames.npy', 'wb') as frames, open(part / 'masks.npy', 'wb') as masks:
            def restart() -> None:
                for stream in (frames, masks):
                    _empty(stream)

            restart()
            columns = decode_file(path, dict(job.found), lambda pixels: frames.write(pixels.data),
                                  lambda mask: masks.write(mask.data), restart, job.reading)
            size = columns.image_size or (0, 0)
            _write_header(frames, (len(columns.arrays.get('frame_log', ())), *size, 3))
            _write_header(masks, (len(columns.arrays.get('mask_log', ())), *size))
        if 'mask_log' not in columns.arrays:
            (part / 'masks.npy').unlink()
        _sort_frames(part / 'frames.npy', columns.arrays)
        arrays = {k: np.ascontiguousarray(a) for k, a in columns.arrays.items()}
        arrays |= {key: pictures for key in _GOALS
                   if (pictures := getattr(columns, key)) is not None}
        save_file(arrays, part / 'columns.safetensors', {'columns': columns.describe()})
        _put(part, folder, path)
    except OSError as error:
        raise RecordingError(f'{folder}: the cache cannot be written: {error}') from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _put(part: Path, folder: Path, path: Path) -> None:
    """Give a finished folder its name; one that is there stays, unless it cannot be read."""
    if folder.exists() and _load(folder, path) is None:
        broken = Path(tempfile.mkdtemp(prefix=folder.name + '.', dir=folder.parent))
        try:
            os.rename(folder, broken / 'broken')
        except FileNotFoundError:  # another process was faster
            pass
        shutil.rmtree(broken, ignore_errors=True)
    try:
        os.rename(part, folder)
    except OSError:
        if _load(folder, path) is None:  # else another process was faster
            raise


def _empty(stream: BinaryIO) -> None:
    """Keep but the room for the header."""
    stream.seek(0)
    stream.truncate()
    stream.write(bytes(_NPY_HEADER))


def _write_header(stream: BinaryIO, shape: tuple[int, ...]) -> None:
    """Put the header of an .npy file in front of what was written."""
    text = repr({'descr': '|u1', 'fortran_order': False, 'shape': shape})
    magic = np.lib.format.magic(1, 0)
    length = _NPY_HEADER - len(magic) - 2
    stream.seek(0)
    stream.write(magic + length.to_bytes(2, 'little') + text.ljust(length - 1).encode() + b'\n')


def _sort_frames(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Bring the frames into the order of their log times, which they nearly always have."""
    order = arrays.pop('frame_order', None)
    if order is not None and (np.diff(order) != 1).any():
        frames = _map(path)
        np.save(path, frames[order], allow_pickle=False)


def _map(path: Path) -> np.ndarray:
    """Map the frames or masks of a cache folder."""
    # numpy reads the header with ast, which now and then fails when threads do so at once.
    with _PARSING:
        return np.load(path, mmap_mode='r')


def _load(folder: Path, source: Path) -> Columns | None:
    """Return the Columns of a cache folder, or None when it is not there or not complete."""
    try:
        arrays = load_file(folder / 'columns.safetensors')
        with open(folder / 'columns.safetensors', 'rb') as stream:
            length = int.from_bytes(stream.read(8), 'little')
            about = json.loads(json.loads(stream.read(length))['__metadata__']['columns'])
        count, num_masks = (len(arrays.get(f'{name}_log', ())) for name in ('frame', 'mask'))
        frames = _map(folder / 'frames.npy') if count else None
        masks = _map(folder / 'masks.npy') if num_masks else None
        if frames is not None and frames.shape != (count, *about['image_size'], 3):
            return None
        if masks is not None and masks.shape != (num_masks, *about['image_size']):
            return None
    except (OSError, EOFError, SafetensorError, ValueError, KeyError):
        return None
    return Columns(
        str(source), tuple(about['image_size']) if count else None,
        tuple(about['camera_size']) if count else None, frames,
        **{key: arrays.pop(key, None) for key in _GOALS}, masks=masks, arrays=arrays,
        names=[tuple(n) for n in about['names']], marks=[tuple(m) for m in about['marks']],
        damage=about['damage'])
