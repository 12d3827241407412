# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Export recordings as a LeRobotDataset v3.0.

What it holds: the camera's pictures as PNG files, actions, the gripper's state and the pixels of
objects where every frame knows them, the task, marks as subtasks, and, in columns of ours, seed
and outcome. Goal pictures, poses and robot masks have no place there.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import json
from pathlib import Path
import shutil
from typing import Any

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.files import storage_errors
from tap_ros.base.options import Bags, File, Folder
from tap_ros.base.progress import Progress
from tap_ros.base.text import counted, escaped
from tap_ros.images.drawing import png_bytes
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.formats.lerobot_format import (
    ACTION,
    CAMERA,
    INDEX,
    INDICES,
    INFO,
    NAMES,
    names_table,
    object_columns,
    OBJECTS,
    OUTCOME,
    SEED,
    STATE,
    SUBTASK,
)
from tap_ros.recording.marks import Mark, read_marks
from tap_ros.recording.reading import reading_of, ReadingOptions
from tap_ros.robots.arm import DEFAULT_ARM

EPISODES_PER_FILE = 100
FILES_PER_CHUNK = 1000
_FILE = 'chunk-{chunk_index:03d}/file-{file_index:03d}'
DATA = f'data/{_FILE}.parquet'
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
_SAMPLED_PIXELS = 2**22  # of all pictures, for their statistics


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param recordings: bag folders, folders of bag folders, or .mcap files.
    :param out: folder of the data set; must not exist.
    :param marks: file of marks (see `mark`); with each the next subtask begins.
    """

    recordings: Bags
    out: Folder
    marks: File = ''
    reading: ReadingOptions = ReadingOptions()


def run(args: Options) -> None:
    """
    Export, and print what the set holds.

    :raises TapError: for recordings that cannot be read, and a folder that is there already.
    """
    out = Path(args.out)
    if out.exists():
        raise ConfigError(f'--out {escaped(out)}: is there already; name a new folder')
    store = open_recordings(list(args.recordings), reading=reading_of(args.reading))
    marks = read_marks(args.marks, store).episodes if args.marks else None
    part = out.with_name(out.name + '.part')
    with storage_errors(part):
        shutil.rmtree(part, ignore_errors=True)
        try:
            features = export(store, part, marks)
            part.rename(out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    print(f'{escaped(out)}: {counted(len(store), "episode")}, {store.num_frames} frames, '
          f'{", ".join(name for name in features if "." in name or name == ACTION)}')


def export(store: EpisodeStore, folder: Path,
           marks: Mapping[int, Sequence[Mark]] | None = None) -> dict[str, Any]:
    """
    Write a data set.

    :param store: EpisodeStore.
    :param folder: a new one.
    :param marks: of episodes; the middle of each is the first frame of the next subtask.
    :return: its features, as in info.json.
    :raises RecordingError: when frames lack what LeRobot needs.
    """
    steps = np.concatenate([np.diff(episode.stamps) for episode in store])
    fps = max(round(1e9 / float(np.median(steps))), 1) if len(steps) else 1
    vectors = _vectors(store)
    tasks = {task: number for number, task in enumerate(dict.fromkeys(
        episode.task or 'unknown' for episode in store))}
    episode = np.repeat(np.arange(len(store)), store.lengths)
    frame = np.concatenate([np.arange(count) for count in store.lengths])
    numbers = {
        **vectors, 'timestamp': frame.astype(np.float32) / np.float32(fps), 'frame_index': frame,
        'episode_index': episode, 'index': np.arange(len(frame)),
        'task_index': np.repeat([tasks[one.task or 'unknown'] for one in store], store.lengths)}
    names: dict[str, dict[str, int]] = {'task': tasks}
    if marks is not None:
        names['subtask'], numbers[SUBTASK] = _subtasks(store, marks)
    features = _features(store, vectors)
    features |= {f'{key}_index': INDEX for key in names}
    rows = list(Progress(_write_files(store, folder, numbers), 'exporting', len(store),
                         unit='episode', delay=1))
    _write_meta(folder, features, names, rows, fps)
    _write_json(folder / 'meta/stats.json', {
        CAMERA: _picture_summary(store),
        **{name: _summary(values.reshape(len(frame), -1)) for name, values in numbers.items()}})
    return features


def _vectors(store: EpisodeStore) -> dict[str, np.ndarray]:
    """Return what every frame knows, (frames, numbers) float32 by name."""
    episodes = list(store)
    found = {ACTION: np.concatenate([e.actions for e in episodes])}
    states = np.concatenate([e.grippers for e in episodes])
    if np.isfinite(states).all():
        found[STATE] = states
    names = {e.object_names for e in episodes}
    if len(names) == 1 and names != {()}:
        pixels = np.concatenate([e.object_pixels.reshape(len(e), -1) for e in episodes])
        if np.isfinite(pixels).all():
            found[OBJECTS] = pixels
    if not np.isfinite(found[ACTION]).all():
        raise RecordingError('recordings: actions hold NaN or infinity')
    return {name: np.ascontiguousarray(values, np.float32) for name, values in found.items()}


def _features(store: EpisodeStore, vectors: dict[str, np.ndarray]) -> dict[str, Any]:
    """Describe the columns, as info.json has it."""
    names = {**NAMES, OBJECTS: object_columns(store[0].object_names)}
    return {
        CAMERA: {'dtype': 'image', 'shape': [*store.image_size, 3],
                 'names': ['height', 'width', 'channels']},
        **{name: {'dtype': 'float32', 'shape': [values.shape[1]], 'names': names[name]}
           for name, values in vectors.items()},
        'timestamp': {'dtype': 'float32', 'shape': [1], 'names': None},
        **dict.fromkeys(INDICES, INDEX)}


def _subtasks(store: EpisodeStore,
              marks: Mapping[int, Sequence[Mark]]) -> tuple[dict[str, int], np.ndarray]:
    """Return the numbers of subtasks by name, and that of every frame, int64."""
    most = max(map(len, marks.values()), default=0)
    names = [*(f'to mark {k + 1}' for k in range(most)), 'to the goal', 'not marked']
    found = []
    for i, T in enumerate(store.lengths.tolist()):
        at = [(first + last) // 2 for first, last in marks.get(i, ())]
        passed = np.searchsorted(at, np.arange(T), side='right')
        passed[passed == len(at)] = most if at else most + 1
        found.append(passed)
    return {name: number for number, name in enumerate(names)}, np.concatenate(found)


def _write_files(store: EpisodeStore, folder: Path,
                 numbers: dict[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """Write data, a row group an episode; yield the rows of meta/episodes."""
    from pyarrow import parquet
    index = 0  # of the first frame of an episode
    for number in range(-(-len(store) // EPISODES_PER_FILE)):
        place = {'chunk_index': number // FILES_PER_CHUNK, 'file_index': number % FILES_PER_CHUNK}
        path = folder / DATA.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        writer, first = None, number * EPISODES_PER_FILE
        for i in range(first, min(first + EPISODES_PER_FILE, len(store))):
            episode, count = store[i], int(store.lengths[i])
            row = {'episode_index': i, 'tasks': [episode.task or 'unknown'], 'length': count,
                   'dataset_from_index': index, 'dataset_to_index': index + count,
                   SEED: int(episode.seed), OUTCOME: episode.outcome,
                   'meta/episodes/chunk_index': 0, 'meta/episodes/file_index': 0,
                   **{f'data/{key}': value for key, value in place.items()}}
            table = _table({name: values[index:index + count] for name, values in numbers.items()},
                           episode.frames)
            writer = writer or parquet.ParquetWriter(path, table.schema)
            writer.write_table(table)
            index += count
            yield row
        if writer:
            writer.close()


def _table(numbers: dict[str, np.ndarray], frames: np.ndarray) -> Any:
    """Return the rows of an episode, with frames (T, H, W, 3) as PNG files."""
    import pyarrow
    pictures = pyarrow.array(
        [{'bytes': png_bytes(frame), 'path': f'frame-{t:06d}.png'}
         for t, frame in enumerate(frames)],
        pyarrow.struct([('bytes', pyarrow.binary()), ('path', pyarrow.string())]))
    return pyarrow.table({CAMERA: pictures} | {
        name: pyarrow.array(values) if values.ndim == 1 else
        pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.ravel()), values.shape[1])
        for name, values in numbers.items()})


def _picture_summary(store: EpisodeStore) -> dict[str, Any]:
    """Return statistics of pictures per channel on [0, 1], of pixels spread over all of them."""
    step = store.num_frames * int(np.prod(store.image_size)) // _SAMPLED_PIXELS | 1  # odd: no grid
    pixels = np.concatenate([store.frames(i).reshape(-1, 3)[::step] for i in range(len(store))])
    found = {name: np.reshape(each, (3, 1, 1)).tolist()
             for name, each in _summary(pixels / 255).items() if name != 'count'}
    return {**found, 'count': [store.num_frames]}


def _summary(values: np.ndarray) -> dict[str, Any]:
    """Return statistics of numbers (frames, numbers)."""
    values = values.astype(np.float64)
    found = {'min': values.min(0), 'max': values.max(0), 'mean': values.mean(0),
             'std': values.std(0)}
    found |= {f'q{round(100 * q):02d}': np.quantile(values, q, 0) for q in _QUANTILES}
    return {name: each.tolist() for name, each in found.items()} | {'count': [len(values)]}


def _write_meta(folder: Path, features: dict[str, Any], names: dict[str, dict[str, int]],
                rows: list[dict[str, Any]], fps: int) -> None:
    """Write what describes the set."""
    import pyarrow
    from pyarrow import parquet
    _write_json(folder / INFO, {
        'codebase_version': 'v3.0', 'robot_type': DEFAULT_ARM, 'fps': fps,
        'total_episodes': len(rows), 'total_frames': rows[-1]['dataset_to_index'],
        'total_tasks': len(names['task']), 'chunks_size': FILES_PER_CHUNK,
        'data_files_size_in_mb': 100, 'video_files_size_in_mb': 200,
        'splits': {'train': f'0:{len(rows)}'}, 'data_path': DATA,
        'video_path': None, 'features': features})
    episodes = folder / 'meta' / 'episodes' / 'chunk-000' / 'file-000.parquet'
    episodes.parent.mkdir(parents=True)
    parquet.write_table(pyarrow.Table.from_pylist(rows), episodes)
    for key, numbers in names.items():
        parquet.write_table(names_table(key, numbers), folder / 'meta' / f'{key}s.parquet')


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + '\n')
