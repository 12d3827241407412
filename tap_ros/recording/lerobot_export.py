# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Export recordings as a LeRobotDataset v3.0.

What it holds: the camera's pictures, actions, the gripper's state and the pixels of objects where
every frame knows them, the task, and, in columns of ours, seed and outcome. Goal pictures, poses
and robot masks have no place there.
"""

from dataclasses import dataclass
import json
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

import cv2
import numpy as np
from tap_ros.errors import ConfigError, RecordingError, StorageError
from tap_ros.files import storage_errors
from tap_ros.images.drawing import png_bytes
from tap_ros.options import Bags, Flag, Folder
from tap_ros.recording import lerobot
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.reading import reading_of
from tap_ros.recording.reading_options import ReadingOptions
from tap_ros.text import escaped
from tqdm import tqdm

if TYPE_CHECKING:
    import pyarrow
    import pyarrow.parquet

FILE_BYTES = 100 * 2**20  # of a data file, before the next one begins
VIDEO_FRAMES = 20_000  # likewise, of a video
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param recordings: bag folders, folders of bag folders, or .mcap files.
    :param out: folder of the data set; must not exist.
    :param lossless: keep pictures as PNG, bit for bit, instead of videos (VP9).
    :param fps: frames a second; 0: as the stamps say, rounded.
    """

    recordings: Bags
    out: Folder
    lossless: Flag = False
    fps: int = 0
    reading: ReadingOptions = ReadingOptions()


def run(args: Options) -> None:
    """
    Export, and print what the set holds.

    :raises TapError: for recordings that cannot be read, and a folder that is there already.
    """
    if not 0 <= args.fps <= 1000:
        raise ConfigError(f'--fps {args.fps}: expected 1 to 1000, or 0')
    out = Path(args.out)
    if out.exists():
        raise ConfigError(f'--out {escaped(out)}: is there already; name a new folder')
    store = open_recordings(list(args.recordings), reading=reading_of(args.reading))
    part = out.with_name(out.name + '.part')
    with storage_errors(part):
        shutil.rmtree(part, ignore_errors=True)
        try:
            features = export(store, part, args.lossless, args.fps)
            part.rename(out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    print(f'{escaped(out)}: {len(store)} episodes, {store.num_frames} frames, '
          f'{", ".join(name for name in features if "." in name or name == lerobot.ACTION)}')


def export(store: EpisodeStore, folder: Path, lossless: bool = False,
           fps: int = 0) -> dict[str, Any]:
    """
    Write a data set.

    :param store: EpisodeStore.
    :param folder: a new one.
    :param lossless: pictures as PNG instead of videos.
    :param fps: frames a second; 0: as the stamps say.
    :return: its features, as in info.json.
    :raises RecordingError: when frames lack what LeRobot needs.
    """
    import pyarrow
    fps = fps or _rate(store)
    vectors = _vectors(store)
    features = _features(store, vectors, lossless, fps)
    tasks: dict[str, int] = {}
    rows: list[dict[str, Any]] = []
    stats = _PictureStats()
    data, video, index = _Data(folder), None, 0
    if not lossless:
        video = _Videos(folder, store.image_size, fps)
    for i in tqdm(range(len(store)), 'exporting', unit='episode', delay=1):
        episode, count = store[i], int(store.lengths[i])
        task = tasks.setdefault(episode.task or 'unknown', len(tasks))
        stats.add(episode.frames)
        columns: dict[str, Any] = {
            name: pyarrow.FixedSizeListArray.from_arrays(
                pyarrow.array(values[index:index + count].ravel()), values.shape[1])
            for name, values in vectors.items()}
        columns |= {
            'timestamp': pyarrow.array(np.arange(count, dtype=np.float32) / np.float32(fps)),
            'frame_index': pyarrow.array(np.arange(count)),
            'episode_index': pyarrow.array(np.full(count, i)),
            'index': pyarrow.array(np.arange(index, index + count)),
            'task_index': pyarrow.array(np.full(count, task))}
        row: dict[str, Any] = {
            'episode_index': i, 'tasks': [episode.task or 'unknown'], 'length': count,
            'dataset_from_index': index, 'dataset_to_index': index + count,
            lerobot.SEED: int(episode.seed), lerobot.OUTCOME: episode.outcome,
            'meta/episodes/chunk_index': 0, 'meta/episodes/file_index': 0}
        if video is not None:
            row |= video.add(episode.frames)
        else:
            columns = {lerobot.CAMERA: pyarrow.array(
                [{'bytes': png_bytes(frame), 'path': f'frame-{t:06d}.png'}
                 for t, frame in enumerate(episode.frames)],
                pyarrow.struct([('bytes', pyarrow.binary()), ('path', pyarrow.string())]))
            } | columns
        row |= data.add(pyarrow.table(columns))
        rows.append(row)
        index += count
    data.close()
    if video is not None:
        video.close()
    _write_meta(folder, features, tasks, rows, fps, index)
    numbers = vectors | {
        'timestamp': np.concatenate([np.arange(n) / fps for n in store.lengths])[:, None],
        'frame_index': np.concatenate([np.arange(n) for n in store.lengths])[:, None],
        'episode_index': np.repeat(np.arange(len(store)), store.lengths)[:, None],
        'index': np.arange(index)[:, None],
        'task_index': np.repeat([tasks[row['tasks'][0]] for row in rows], store.lengths)[:, None]}
    _write_json(folder / lerobot.STATS, {
        lerobot.CAMERA: stats.summary(),
        **{name: _summary(values) for name, values in numbers.items()}})
    return features


def _rate(store: EpisodeStore) -> int:
    """Return the frames a second that the stamps say."""
    steps = np.concatenate([np.diff(store[i].stamps) for i in range(len(store))])
    return max(round(1e9 / float(np.median(steps))), 1) if len(steps) else 1


def _vectors(store: EpisodeStore) -> dict[str, np.ndarray]:
    """Return what every frame knows, (frames, numbers) float32 by name."""
    episodes = [store[i] for i in range(len(store))]
    found = {lerobot.ACTION: np.concatenate([e.actions for e in episodes])}
    states = np.concatenate([e.grippers for e in episodes])
    if np.isfinite(states).all():
        found[lerobot.STATE] = states
    names = {e.object_names for e in episodes}
    if len(names) == 1 and names != {()}:
        pixels = np.concatenate([e.object_pixels.reshape(len(e), -1) for e in episodes])
        if np.isfinite(pixels).all():
            found[lerobot.OBJECTS] = pixels
    if not np.isfinite(found[lerobot.ACTION]).all():
        raise RecordingError('recordings: actions hold NaN or infinity')
    return {name: np.ascontiguousarray(values, np.float32) for name, values in found.items()}


def _features(store: EpisodeStore, vectors: dict[str, np.ndarray], lossless: bool,
              fps: int) -> dict[str, Any]:
    """Describe the columns, as info.json has it."""
    height, width = store.image_size
    camera: dict[str, Any] = {'dtype': 'image' if lossless else 'video',
                              'shape': [height, width, 3],
                              'names': ['height', 'width', 'channels']}
    if not lossless:
        camera['info'] = {'video.height': height, 'video.width': width, 'video.channels': 3,
                          'video.codec': 'vp9', 'video.pix_fmt': 'yuv420p', 'video.fps': fps,
                          'video.is_depth_map': False, 'has_audio': False}
    names = {lerobot.ACTION: list(lerobot.ACTION_NAMES), lerobot.STATE: list(lerobot.STATE_NAMES),
             lerobot.OBJECTS: lerobot.object_columns(store[0].object_names)}
    return {
        lerobot.CAMERA: camera,
        **{name: {'dtype': 'float32', 'shape': [values.shape[1]], 'names': names[name]}
           for name, values in vectors.items()},
        'timestamp': {'dtype': 'float32', 'shape': [1], 'names': None},
        **{name: {'dtype': 'int64', 'shape': [1], 'names': None} for name in (
            'frame_index', 'episode_index', 'index', 'task_index')}}


class _Data:
    """Data files, a row group an episode."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number = folder, -1
        self._writer: pyarrow.parquet.ParquetWriter | None = None
        self._path = folder

    def add(self, table: 'pyarrow.Table') -> dict[str, int]:
        """Append an episode; return where it is."""
        from pyarrow import parquet
        if self._writer is None or self._path.stat().st_size > FILE_BYTES:
            self.close()
            self._number += 1
            self._path = self._folder / lerobot.DATA.format(**lerobot.place(self._number))
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = parquet.ParquetWriter(self._path, table.schema)
        self._writer.write_table(table)
        return {f'data/{name}': number for name, number in lerobot.place(self._number).items()}

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class _Videos:
    """Videos of several episodes, one after the other."""

    def __init__(self, folder: Path, size: tuple[int, int], fps: int) -> None:
        self._folder, self._size, self._fps = folder, size, fps
        self._writer: cv2.VideoWriter | None = None
        self._number, self._frames = -1, 0

    def add(self, frames: np.ndarray) -> dict[str, Any]:
        """Append an episode; return where it is."""
        if self._writer is None or self._frames >= VIDEO_FRAMES:
            self.close()
            self._number, self._frames = self._number + 1, 0
            path = self._folder / lerobot.VIDEO.format(
                video_key=lerobot.CAMERA, **lerobot.place(self._number))
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = cv2.VideoWriter(
                str(path), cv2.VideoWriter.fourcc(*'vp09'), self._fps, self._size[::-1])
            if not self._writer.isOpened():
                raise StorageError(f'{path}: OpenCV cannot write this video; use --lossless')
        for frame in frames:
            self._writer.write(np.ascontiguousarray(frame[..., ::-1]))
        begin, self._frames = self._frames, self._frames + len(frames)
        key = f'videos/{lerobot.CAMERA}/'
        return {**{key + name: number for name, number in lerobot.place(self._number).items()},
                key + 'from_timestamp': begin / self._fps,
                key + 'to_timestamp': self._frames / self._fps}

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None


class _PictureStats:
    """Statistics of all pictures, per channel on [0, 1], from their histograms."""

    def __init__(self) -> None:
        self._counts, self._frames = np.zeros((3, 256), np.int64), 0

    def add(self, frames: np.ndarray) -> None:
        for channel in range(3):
            self._counts[channel] += np.bincount(frames[..., channel].ravel(), minlength=256)
        self._frames += len(frames)

    def summary(self) -> dict[str, Any]:
        values, counts = np.arange(256) / 255, self._counts
        total = counts.sum(1)
        mean = counts @ values / total
        std = np.sqrt(np.maximum(counts @ values**2 / total - mean**2, 0))
        shares = counts.cumsum(1) / total[:, None]
        seen = [values[row > 0] for row in counts]
        found = {'min': [each[0] for each in seen], 'max': [each[-1] for each in seen],
                 'mean': mean, 'std': std}
        found |= {f'q{round(100 * q):02d}': values[(shares < q).sum(1)] for q in _QUANTILES}
        return {name: np.reshape(each, (3, 1, 1)).tolist() for name, each in found.items()} | {
            'count': [self._frames]}


def _summary(values: np.ndarray) -> dict[str, Any]:
    """Return statistics of numbers (frames, numbers)."""
    values = values.astype(np.float64)
    found = {'min': values.min(0), 'max': values.max(0), 'mean': values.mean(0),
             'std': values.std(0)}
    found |= {f'q{round(100 * q):02d}': np.quantile(values, q, 0) for q in _QUANTILES}
    return {name: each.tolist() for name, each in found.items()} | {'count': [len(values)]}


def _write_meta(folder: Path, features: dict[str, Any], tasks: dict[str, int],
                rows: list[dict[str, Any]], fps: int, frames: int) -> None:
    """Write what describes the set."""
    import pyarrow
    from pyarrow import parquet
    video = features[lerobot.CAMERA]['dtype'] == 'video'
    _write_json(folder / lerobot.INFO, {
        'codebase_version': lerobot.VERSION, 'robot_type': 'ur10e', 'fps': fps,
        'total_episodes': len(rows), 'total_frames': frames, 'total_tasks': len(tasks),
        'chunks_size': lerobot.FILES_PER_CHUNK, 'data_files_size_in_mb': FILE_BYTES // 2**20,
        'video_files_size_in_mb': 200, 'splits': {'train': f'0:{len(rows)}'},
        'data_path': lerobot.DATA, 'video_path': lerobot.VIDEO if video else None,
        'features': features})
    episodes = folder / lerobot.EPISODES.format(**lerobot.place(0))
    episodes.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.Table.from_pylist(rows), episodes)
    table = pyarrow.table({'task_index': list(tasks.values()), 'task': list(tasks)})
    # As pandas writes a table whose index are the tasks: LeRobot reads it with pandas.
    described = {'index_columns': ['task'], 'column_indexes': [], 'columns': [
        {'name': 'task_index', 'field_name': 'task_index', 'pandas_type': 'int64',
         'numpy_type': 'int64', 'metadata': None},
        {'name': 'task', 'field_name': 'task', 'pandas_type': 'unicode', 'numpy_type': 'object',
         'metadata': None}]}
    parquet.write_table(table.replace_schema_metadata({'pandas': json.dumps(described)}),
                        folder / lerobot.TASKS)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + '\n')
