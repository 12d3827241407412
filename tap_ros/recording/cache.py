# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings as memory maps: decoded once, kept in a cache, then read at the speed of memory.

Each file of a recording has a folder in the cache, named after the SHA-256 of its content, with
its pictures as uint8 arrays, and all else as columns. Any number of processes may build and read
it at once.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
import hashlib
import itertools
import json
import math
import multiprocessing
import os
from pathlib import Path
import shutil
import tempfile

import numpy as np
from safetensors import safe_open, SafetensorError
from safetensors.numpy import save_file
from tap_ros.base.engines import run_tasks, Work
from tap_ros.base.errors import EngineError, RecordingError
from tap_ros.recording.align import assemble, runs_of
from tap_ros.recording.bags import check_sizes, find_bags, warn_of_damage
from tap_ros.recording.columns import Columns, decode_file, PICTURES
from tap_ros.recording.episode import Episode, EpisodeTable
from tap_ros.recording.metadata import ArmMount, read_mount
from tap_ros.recording.reading import AS_RECORDED, for_bags, Reading
from tap_ros.recording.topic_choice import find_topics, list_paths
from tqdm import tqdm

FORMAT = 9  # of a cache folder; another number makes all files be decoded again
ENVIRONMENT = 'TAP_ROS_CACHE'
_ALONE_BYTES = 2**24  # of files that are decoded before other processes would have started


class EpisodeStore:
    """
    Episodes of recordings, in their order, as views of memory maps.

    :param tables: list of EpisodeTable.
    :param file_hashes: hex digests of the files, in order, and what else tells them apart.
    :param sources: of each table, the first file of its bag.
    :ivar image_size: (height, width) of the frames.
    :ivar camera_size: likewise, as they were recorded; None where that differs.
    :ivar marked: whether marks tell episodes apart, in some of the recordings at least.
    """

    def __init__(self, tables: Sequence[EpisodeTable], file_hashes: Iterable[str],
                 sources: Sequence[Path]) -> None:
        self._index = [(table, i) for table in tables for i in range(len(table))]
        self._sources = [source for table, source in zip(tables, sources, strict=True)
                         for _ in range(len(table))]
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

    def __iter__(self) -> Iterator[Episode]:
        """Yield the episodes."""
        return (self[i] for i in range(len(self)))

    def source(self, i: int) -> Path:
        """Return the first file of the bag that episode i is in."""
        return self._sources[i]

    def frames(self, i: int) -> np.ndarray:
        """Return the frames of episode i, (T, H, W, 3) uint8."""
        table, local = self._index[i]
        return table.frames(local)

    def seen(self, i: int) -> tuple[int, int]:
        """Return the log times in ns from the first to the last frame of episode i."""
        table, local = self._index[i]
        logs = table.logs[table.starts[local]:table.starts[local + 1]]
        return int(logs.min()), int(logs.max())

    def has_masks(self, i: int) -> bool:
        """Return whether every frame of episode i has a robot mask."""
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
    found = [bag for path in paths for bag in find_bags(path)]
    cutting = for_bags(reading, len(found))
    bags, cameras = zip(*itertools.product(found, reading.cameras))
    cache_dir = Path(cache_dir) if cache_dir else cache_folder()
    with tqdm(total=sum(file.stat().st_size for bag in bags for file in bag),
              desc='decoding once', unit='B', unit_scale=True, disable=not progress,
              delay=1) as bar:
        jobs = _jobs(bags, list(map(find_topics, bags, cameras)), reading, cache_dir)
        loaded = {job: _load(job) for bag in jobs for job in bag}
        bar.update(sum(job.size for job, part in loaded.items() if part is not None))
        missing = [job for job, part in loaded.items() if part is None]
        for job in _built(missing):
            bar.update(job.size)
        loaded |= {job: _load(job) for job in missing}
    unread = next((job.folder for job, part in loaded.items() if part is None), None)
    if unread is not None:
        raise RecordingError(f'{unread}: the cache cannot be read back; is the disk full?')
    columns = [[part for job in bag if (part := loaded[job]) is not None] for bag in jobs]
    check_sizes([part for bag in columns for part in bag])
    for part in (part for bag in columns for part in bag):
        warn_of_damage(part)
    arms = [read_mount(bag[0].parent) for bag in bags]
    runs = [(run, arm, bag[0]) for parts, arm, bag in zip(columns, arms, bags)
            for run in runs_of(parts)]
    tables = [assemble(run, arm, cutting) for run, arm, _ in runs]
    # What is read depends on these, too.
    apart = [repr(arm) for arm in arms if arm != ArmMount()]
    if len(reading.cameras) > 1:
        apart.append(repr(reading.cameras))
    if replace(reading, image_topic='') != AS_RECORDED:
        apart.append(repr(replace(reading, image_topic='')))
    store = EpisodeStore(tables, [*(job.digest for bag in jobs for job in bag), *apart],
                         [source for _, _, source in runs])
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
    found: tuple[tuple[str, str], ...]  # topics and names of their columns
    reading: Reading
    folder: Path  # of the cache


def _jobs(bags: Sequence[Sequence[Path]], found: Sequence[Mapping[str, str]], reading: Reading,
          cache_dir: Path) -> list[list[_Job]]:
    """Return a list of _Job for each bag."""
    def job(path: Path, names: Mapping[str, str]) -> _Job:
        with open(path, 'rb') as stream:
            digest = hashlib.file_digest(stream, 'sha256')
        if (log := path.with_name(f'{path.name}-wal')).is_file():  # of a recorder that was killed
            digest.update(log.read_bytes())
        key = hashlib.sha256(json.dumps([
            FORMAT, sorted(names.items()), reading.crop, reading.size, reading.rate,
        ]).encode()).hexdigest()[:8]
        return _Job(path, path.stat().st_size, digest.hexdigest(), tuple(names.items()), reading,
                    cache_dir / f'{digest.hexdigest()}-{key}')
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        waiting = [[pool.submit(job, path, names) for path in bag]
                   for bag, names in zip(bags, found, strict=True)]
        return [[task.result() for task in bag] for bag in waiting]


def _built(jobs: Sequence[_Job]) -> Iterator[_Job]:
    """
    Decode files into their cache folders; yield the jobs that are done.

    Decoding is Python and holds its lock, so that processes do it where there is much to do.
    """
    left = list(jobs)
    if (len(left) > 1 and sum(job.size for job in left) > _ALONE_BYTES
            and not multiprocessing.current_process().daemon):  # which may not have children
        with suppress(EngineError):  # one cannot import the user's script, or was killed
            for work, get in run_tasks([Work(str(job.path), _build, (job,)) for job in jobs]):
                get()
                left.remove(work.args[0])
                yield work.args[0]
    for job in left:
        _build(job)
        yield job


def _build(job: _Job) -> None:
    """Decode a file into its cache folder, which appears complete or not at all."""
    folder = job.folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=folder.name + '.', dir=folder.parent))
    except OSError as error:
        raise RecordingError(
            f'{folder.parent}: the cache cannot be written ({error.strerror}); set {ENVIRONMENT} '
            'to a folder that can') from error
    try:
        with ExitStack() as stack:
            streams = {name: stack.enter_context(open(part / name, 'wb')) for name in PICTURES}
            columns = decode_file(
                job.path, dict(job.found),
                lambda name, pixels: streams[name].write(pixels.data), job.reading)
        arrays = {key: np.ascontiguousarray(a) for key, a in columns.arrays.items()}
        save_file(arrays, part / 'columns.safetensors', {'columns': columns.describe()})
        _put(part, job)
    except OSError as error:
        raise RecordingError(f'{folder}: the cache cannot be written: {error}') from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _put(part: Path, job: _Job) -> None:
    """Give a finished folder its name; one that is there stays, unless it cannot be read."""
    try:
        os.rename(part, job.folder)
    except OSError:
        if _load(job) is None:  # else another process was faster
            shutil.rmtree(job.folder, ignore_errors=True)
            os.rename(part, job.folder)


def _load(job: _Job) -> Columns | None:
    """Return the Columns of a cache folder, or None when it is not there or not complete."""
    try:
        with safe_open(job.folder / 'columns.safetensors', 'numpy') as file:
            about = json.loads(file.metadata()['columns'])
            arrays = {key: file.get_tensor(key) for key in file.keys()}
        pictures: dict[str, np.ndarray] = {}
        for name, shape in about['shapes'].items():
            if (job.folder / name).stat().st_size != math.prod(shape):
                return None
            pictures[name] = np.memmap(job.folder / name, np.uint8, 'r', shape=tuple(shape))
        sizes = {key: about[key] and tuple(about[key]) for key in ('image_size', 'camera_size')}
        return Columns(str(job.path), **about | sizes | {
            key: [tuple(one) for one in about[key]] for key in ('names', 'marks')},
            pictures=pictures, arrays=arrays)
    except (OSError, SafetensorError, ValueError, LookupError, TypeError):
        return None
