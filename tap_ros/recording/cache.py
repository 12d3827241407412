# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recordings as memory maps: decoded once, kept in a cache, then read at the speed of memory.

Each file of a recording has a folder in the cache, named after the SHA-256 of its content, with
its pictures as uint8 arrays, and all else as columns. Any number of processes may build and read
it at once.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
import hashlib
from itertools import chain, product
import json
import math
import multiprocessing
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any
import warnings

import numpy as np
from safetensors import safe_open, SafetensorError
from safetensors.numpy import save_file
from tap_ros.base.engines import run_tasks, Work
from tap_ros.base.errors import (
    ConfigError,
    EngineError,
    ImageError,
    RecordingError,
    RecordingWarning,
)
from tap_ros.base.progress import Progress
from tap_ros.base.text import escaped
from tap_ros.images.crop import CENTRE, check_trainable
from tap_ros.recording.align import assemble, runs_of
from tap_ros.recording.bags import find_bags, Paths
from tap_ros.recording.columns import Columns, decode_file, PICTURES
from tap_ros.recording.episode import Episode, EpisodeTable
from tap_ros.recording.known import cache_folder, digest_of, ENVIRONMENT, FORMAT, remembered
from tap_ros.recording.mcap_file import McapFile
from tap_ros.recording.metadata import ArmMount, read_mount
from tap_ros.recording.periods import last_told
from tap_ros.recording.reading import AS_RECORDED, Reading
from tap_ros.recording.topic_choice import Bag, list_paths

_ALONE_BYTES = 2**24  # of files that are decoded before other processes would have started


class EpisodeStore:
    """
    Episodes of recordings, in their order, as views of memory maps.

    :param tables: list of EpisodeTable.
    :param file_hashes: hex digests of the files, in order, and what else tells them apart.
    :param bags: that of each table.
    :ivar image_size: (height, width) of the frames.
    :ivar camera_size: (height, width) as they were recorded; None where that differs.
    :ivar cameras: topics of the cameras, sorted.
    :ivar commands: units of those to the arm; older recordings have metres in a control period.
    :ivar marked: whether marks tell episodes apart, in some of the recordings at least.
    """

    def __init__(self, tables: Sequence[EpisodeTable], file_hashes: Iterable[str],
                 bags: Sequence[Bag]) -> None:
        self._index = [(table, i) for table in tables for i in range(len(table))]
        self._bags = [bag for table, bag in zip(tables, bags, strict=True) for _ in table.spans]
        lengths = [np.diff(table.starts) for table in tables]
        self.lengths = np.concatenate([np.empty(0, np.int64), *lengths])  # (E,) frames
        self.num_frames = int(self.lengths.sum())
        parts = [part for table in tables for part in table.parts]
        self.image_size = next(part.image_size for part in parts if part.image_size)
        sizes = {part.camera_size for part in parts if part.camera_size}
        self.camera_size = sizes.pop() if len(sizes) == 1 else None
        self.cameras = sorted({part.topics['frame'] for part in parts})
        self.commands = sorted({'m/s' if 'period' in part.topics else 'm in a control period'
                                for part in parts if 'twist' in part.topics})
        self.marked = any(part.marks for part in parts)
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

    def bag(self, i: int) -> Bag:
        """Return the bag that episode i is in."""
        return self._bags[i]

    def source(self, i: int) -> Path:
        """Return the first file of the bag that episode i is in."""
        return self._bags[i].files[0]

    def frames(self, i: int) -> np.ndarray:
        """Return the frames of episode i, (T, H, W, 3) uint8."""
        table, local = self._index[i]
        return table.frames(local)

    def seconds(self, i: int) -> np.ndarray:
        """Return the times of the frames of episode i, (T,) s from its first one."""
        table, local = self._index[i]
        stamps = table.stamps[table.starts[local]:table.starts[local + 1]]
        return np.asarray((stamps - stamps[0]) / 1e9)

    def logs(self, i: int) -> np.ndarray:
        """Return when the frames of episode i were logged, (T,) int64 ns."""
        table, local = self._index[i]
        return table.logs[table.starts[local]:table.starts[local + 1]]

    def recorded(self, i: int, t: int) -> tuple[Path, str, int, int]:
        """Return where frame t of episode i was recorded: file, topic, log time and stamp, ns."""
        table, local = self._index[i]
        file, index = (int(places[table.starts[local] + t]) for places in table.places['frame'])
        part = table.parts[file]
        log, stamp = part.arrays['frame'][index, :2].tolist()
        return Path(part.source), part.topics['frame'], log, stamp

    def seen(self, i: int) -> tuple[int, int]:
        """Return the log times in ns from the first to the last frame of episode i."""
        logs = self.logs(i)
        return int(logs.min()), int(logs.max())

    def has_masks(self, i: int) -> bool:
        """Return whether every frame of episode i has a robot mask."""
        table, local = self._index[i]
        return table.has_masks(local)


def open_recordings(paths: Paths, cache_dir: str | Path | None = None, progress: bool = True,
                    reading: Reading = AS_RECORDED, network: str = '') -> EpisodeStore:
    """
    Open recordings, decoding what is not in the cache yet.

    :param paths: one or a list of .mcap files, bag folders, or folders of bag folders.
    :param cache_dir: by default $TAP_ROS_CACHE or ~/.cache/tap_ros.
    :param progress: show a progress bar when decoding takes long.
    :param reading: Reading: which pictures, which part of them, and where episodes are cut.
    :param network: what is to learn from them, such as 'the predictor'; pictures of a size that
        no network of ours takes are then refused before they are decoded.
    :return: EpisodeStore.
    :raises RecordingError: when a recording is missing, empty, damaged or lacks the image topic,
        or when the images differ in size; the message names the file.
    :raises ConfigError: for sizes that the network cannot take.
    """
    found, cache = find_bags(paths), Path(cache_dir) if cache_dir else cache_folder()
    bags, cameras = zip(*product(found, reading.cameras))
    # What each file is, and which topics are read: known from before, or found out.
    files = list(dict.fromkeys(chain.from_iterable(bag.files for bag in bags)))
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        digests = dict(zip(files, pool.map(partial(digest_of, cache), files)))
    choices = [
        remembered(cache, ['topics', camera, *map(digests.__getitem__, bag.files)],
                   lambda: asdict(bag.choose(camera)))  # noqa: B023  it is called at once
        for bag, camera in zip(bags, cameras)]
    for bag, choice in zip(bags, choices):
        for doubt in choice['doubts']:
            warnings.warn(f'{bag.source}: {doubt}', RecordingWarning, stacklevel=2)
    if network:
        _check_first_sizes({tuple(choice['size']) for choice in choices if choice['size']},
                           reading, network)
    # What each file holds: from the cache, or decoded into it.
    folders = [[_folder(cache, digests[path], choice['topics'], reading) for path in bag.files]
               for bag, choice in zip(bags, choices)]
    loaded = _loaded({folder: (bag, number, choice['topics'])
                      for bag, choice, own in zip(bags, choices, folders)
                      for number, folder in enumerate(own)}, reading, progress)
    columns = [[loaded[folder] for folder in own] for own in folders]
    _check_sizes(list(chain(*columns)))
    # Episodes of the files that follow each other.
    arms = [read_mount(bag.files[0].parent) for bag in bags]
    cutting = reading if len(found) == 1 else replace(reading, episode_seconds=0)
    runs = []
    for parts, arm, bag in zip(columns, arms, bags):
        period = None  # that is told once holds, also where the clock is set back between files
        for run in runs_of(parts):
            runs.append((assemble(run, arm, cutting, period), bag))
            period = last_told(run, period)
    apart: list[Any] = [asdict(arm) for arm in arms if arm != ArmMount()]
    if len(reading.cameras) > 1:
        apart.append(reading.cameras)
    if replace(reading, image_topic='') != AS_RECORDED:
        apart.append(asdict(reading) | {'image_topic': ''})
    store = EpisodeStore(
        [table for table, _ in runs],
        [*(digests[path] for bag in bags for path in bag.files), *map(json.dumps, apart)],
        [bag for _, bag in runs])
    if not len(store):
        raise RecordingError(f'{found[0].source}: no camera image lies within an episode')
    return store


def _check_first_sizes(sizes: set[tuple[int, ...]], reading: Reading, network: str) -> None:
    """Refuse the (height, width) of first pictures that no network of ours takes."""
    for size in sizes:
        with suppress(ImageError):  # whoever cuts them says so
            check_trainable(reading.cut.cut_size(size), network)
    if len(sizes) > 1 and reading.crop not in ('', CENTRE):
        found = ', '.join('{1}x{0}'.format(*size) for size in sorted(sizes))
        raise ConfigError(f'recordings: pictures of different sizes, {found}; --crop '
                          f'{reading.crop} is another part of each, use --crop {CENTRE} or '
                          'train on them apart')


def _check_sizes(parts: Sequence[Columns]) -> None:
    """Refuse recordings whose images differ in size, naming them; warn of what is damaged."""
    sizes: dict[tuple[int, int], str] = {}
    for part in parts:
        if part.image_size is not None:
            sizes.setdefault(part.image_size, part.source)
    if not sizes:
        why = next((f'{part.source}: {part.damage[0]}' for part in parts if part.damage), '')
        raise RecordingError(
            f'{list_paths([part.source for part in parts])}: the image topic holds no image'
            + (f' that can be used; {why}' if why else ''))
    if len(sizes) > 1:
        listing = ', '.join(f'{s} ({w}x{h})' for (h, w), s in sizes.items())
        raise RecordingError(
            f'images of different sizes (width x height): {listing}; open them separately')
    for part in parts:
        for line in part.damage:
            warnings.warn(f'{escaped(part.source)}: {line}', RecordingWarning, stacklevel=3)


def _folder(cache: Path, digest: str, topics: dict[str, str], reading: Reading) -> Path:
    """Return the folder for a file that is read in one way."""
    key = json.dumps([FORMAT, sorted(topics.items()), reading.crop, reading.size, reading.rate])
    return cache / f'{digest}-{hashlib.sha256(key.encode()).hexdigest()[:8]}'


def _loaded(wanted: dict[Path, tuple[Bag, int, dict[str, str]]], reading: Reading,
            progress: bool) -> dict[Path, Columns]:
    """Return what files of bags hold, by their folder of the cache, decoding what is not there."""
    found = {folder: _load(folder, bag.files[number])
             for folder, (bag, number, _) in wanted.items()}
    works = [Work(str(bag.files[number]), _build, (bag.opened[number], folder, topics, reading))
             for folder, (bag, number, topics) in wanted.items() if not found[folder]]
    sizes = [os.stat(work.name).st_size for work in works]
    with Progress(total=sum(sizes), desc='decoding once', unit='B', unit_scale=True,
                  disable=not progress, delay=1) as bar:
        for work in _built(works, together=sum(sizes) > _ALONE_BYTES):
            folder = work.args[1]
            found[folder] = _load(folder, Path(work.name))
            if not found[folder]:
                raise RecordingError(
                    f'{folder}: the cache cannot be read back; is the disk full?')
            bar.update(sizes[works.index(work)])
    return {folder: part for folder, part in found.items() if part}


def _built(works: Sequence[Work], together: bool) -> Iterator[Work]:
    """
    Decode files into their cache folders; yield the works that are done.

    Decoding is Python and holds its lock, so that processes do it where there is much to do.
    """
    left = list(works)
    if together and len(left) > 1 and not (
            multiprocessing.current_process().daemon):  # which may not have children
        with suppress(EngineError):  # one was killed
            for work, get in run_tasks(works, script=False):
                get()
                left.remove(work)
                yield work
    for work in left:
        work.function(*work.args)
        yield work


def _build(file: McapFile, folder: Path, topics: dict[str, str], reading: Reading) -> None:
    """Decode a file into its cache folder, which appears complete or not at all."""
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
                file, topics, lambda name, pixels: streams[name].write(pixels.data), reading)
        file.close()
        arrays = {key: np.ascontiguousarray(a) for key, a in columns.arrays.items()}
        save_file(arrays, part / 'columns.safetensors', {'columns': columns.describe()})
        _put(part, folder)
    except OSError as error:
        raise RecordingError(f'{folder}: the cache cannot be written: {error}') from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _put(part: Path, folder: Path) -> None:
    """Give a finished folder its name; one that is there stays, unless it cannot be read."""
    try:
        os.rename(part, folder)
    except OSError:
        if _load(folder, folder) is None:  # else another process was faster
            shutil.rmtree(folder, ignore_errors=True)
            os.rename(part, folder)


def _load(folder: Path, source: Path) -> Columns | None:
    """Return the Columns of a cache folder, or None when it is not there or not complete."""
    try:
        with safe_open(folder / 'columns.safetensors', 'numpy') as file:
            about = json.loads(file.metadata()['columns'])
            arrays = {key: file.get_tensor(key) for key in file.keys()}
        pictures: dict[str, np.ndarray] = {}
        for name, shape in about['shapes'].items():
            if (folder / name).stat().st_size != math.prod(shape):
                return None
            pictures[name] = np.memmap(folder / name, np.uint8, 'r', shape=tuple(shape))
        sizes = {key: about[key] and tuple(about[key]) for key in ('image_size', 'camera_size')}
        return Columns(str(source), **about | sizes | {
            key: [tuple(one) for one in about[key]] for key in ('names', 'marks')},
            pictures=pictures, arrays=arrays)
    except (OSError, SafetensorError, ValueError, LookupError, TypeError):
        return None
