# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import a LeRobotDataset v3.0 as recordings.

Pictures of one camera, and the task as text. Actions, states and objects only of sets that have
ours: four numbers called dx, dy, dz and opening, and so on; of other robots they would be an arm's
command with another meaning.

In such a set meta/info.json, stats.json and tasks.parquet describe it, meta/episodes has a row an
episode, data a row a frame. Pictures are files in the rows, or videos of several episodes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from tap_ros.contract import GRIPPER_JOINTS
from tap_ros.errors import ConfigError, ImageError, RecordingError
from tap_ros.files import only_writer
from tap_ros.images.crop import Crop
from tap_ros.images.encodings import decompress
from tap_ros.options import Folder
from tap_ros.recording.episode import Episode, OUTCOMES
from tap_ros.recording.reading_options import Part
from tap_ros.recording.writer import EpisodeWriter, write_metadata
from tap_ros.text import escaped, listing
from tqdm import tqdm
from tyro import conf

INFO = 'meta/info.json'
CAMERA = 'observation.images.camera'
STATE, OBJECTS, ACTION = 'observation.state', 'observation.environment_state', 'action'
NAMES = {ACTION: ['dx', 'dy', 'dz', 'opening'], STATE: list(GRIPPER_JOINTS)}  # of our numbers
INDICES = ('frame_index', 'episode_index', 'index', 'task_index')  # columns that all sets have
SEED, OUTCOME = 'tap_ros/seed', 'tap_ros/outcome'  # columns of ours beside LeRobot's
EPISODES_PER_FILE = 25
EPISODE_SPACING_NS = 60 * 10**9  # between the end of an episode and the start of the next
_INFO_BYTES = 2**24


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param path: folder of the data set, with meta/info.json.
    :param out: folder of the bag; must not exist, or be empty.
    :param camera: feature whose pictures are taken; needed where the set has several cameras.
    :param crop: square part of the pictures that is kept, as in train --help.
    :param size: pixels a side that they are scaled to; 0: not scaled.
    """

    path: Annotated[conf.Positional[str], conf.arg(metavar='PATH')]
    out: Folder
    camera: Annotated[str, conf.arg(metavar='FEATURE', help_behavior_hint=(
        '(default: the only one)'))] = ''
    crop: Part = ''
    size: int = 0


def run(args: Options) -> None:
    """
    Import, and print what was.

    :raises TapError: for a set that cannot be read, and a folder that holds something.
    """
    data, out, crop = DataSet(args.path, args.camera), Path(args.out), Crop(args.crop, args.size)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f'--out {escaped(out)}: is not empty; name a new folder')
    with only_writer(out):
        episodes = iter(tqdm(data.episodes(crop), 'importing', len(data.rows), unit='episode',
                             delay=1))
        count = frames = 0
        for number in range(-(-len(data.rows) // EPISODES_PER_FILE)):
            with EpisodeWriter(out / f'{out.resolve().name}_{number}.mcap') as writer:
                for _, episode in zip(range(EPISODES_PER_FILE), episodes):
                    writer.write(episode)
                    count, frames = count + 1, frames + len(episode)
        write_metadata(out)
    print(f'{escaped(out)}: {count} episodes, {frames} frames of {data.camera}')
    if data.unused:
        print(f'not taken: {listing(data.unused)}')


class DataSet:
    """
    A LeRobotDataset v3.0 in a folder.

    :param folder: of the set.
    :param camera: feature whose pictures are taken; '': the only one.
    :ivar rows: of meta/episodes, dicts in the order of the episodes.
    :ivar unused: features that are not taken over.
    :raises RecordingError: when it is none, or damaged.
    :raises ConfigError: for a camera that it has not, or has not alone.
    """

    def __init__(self, folder: str | Path, camera: str = '') -> None:
        self.folder = Path(folder)
        place = escaped(self.folder / INFO)
        try:
            with open(self.folder / INFO, 'rb') as stream:
                info = json.loads(stream.read(_INFO_BYTES))
            version, self.fps = str(info['codebase_version']), float(info['fps'])
            self.features = dict(info['features'])
            self._data_path, self._video_path = str(info['data_path']), info.get('video_path')
            cameras = [name for name, feature in self.features.items()
                       if feature['dtype'] in ('image', 'video')]
        except OSError as error:
            raise RecordingError(f'{place}: cannot be read, so this is no LeRobot data set: '
                                 f'{error.strerror}') from error
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecordingError(f'{place}: not the description of a LeRobot data set; it lacks '
                                 f'or garbles {escaped(error)}') from error
        if not version.startswith('v3.') or not 0 < self.fps <= 1e6:
            raise RecordingError(
                f'{escaped(self.folder)}: version {escaped(version, 20)}, {self.fps} frames a '
                'second; expected v3 (python -m lerobot.scripts.convert_dataset_v21_to_v30 makes '
                'one of v2.1)')
        if not cameras:
            raise RecordingError(f'{escaped(self.folder)}: no feature is of pictures')
        if camera not in cameras and (camera or len(cameras) > 1):
            raise ConfigError(f'--camera: expected one of {", ".join(map(escaped, cameras))}')
        self.camera = camera or cameras[0]
        self._objects = self._object_names()
        taken = {self.camera, 'timestamp', *INDICES, *filter(self._is_ours, NAMES)}
        if self._objects:
            taken.add(OBJECTS)
        self.unused = sorted(self.features.keys() - taken)
        self.rows = self._read_rows()
        self._file: tuple[Path, Any] | None = None  # data file in memory
        # Path, frames and number of the next one of a video.
        self._video: tuple[Path, Iterator[np.ndarray], int] | None = None

    def episodes(self, crop: Crop) -> Iterator[Episode]:
        """
        Yield the episodes.

        :param crop: Crop of the pictures.
        :raises RecordingError: for what cannot be read; it names the file.
        """
        begin = 10**9
        for row in self.rows:
            try:
                episode = self._episode(row, crop, begin)
            except (KeyError, TypeError, ValueError, IndexError, ImageError, OSError) as error:
                raise RecordingError(
                    f'{escaped(self.folder)}: episode {escaped(row["episode_index"], 20)} cannot '
                    f'be read: {escaped(error, 200)}') from error
            begin = int(episode.stamps[-1]) + EPISODE_SPACING_NS
            yield episode

    def _flat_names(self, key: str) -> list[Any]:
        """Return the names of a feature's numbers; some sets have them in a dict, or none."""
        names = self.features.get(key, {}).get('names')
        if isinstance(names, dict):
            return [name for part in names.values()
                    for name in (part if isinstance(part, list) else [part])]
        return names if isinstance(names, list) else []

    def _is_ours(self, key: str) -> bool:
        """Return whether the numbers of a feature mean what they do in our recordings."""
        return self._flat_names(key) == NAMES[key]

    def _object_names(self) -> tuple[str, ...]:
        """Return the objects whose pixels the set has as we export them."""
        columns = list(map(str, self._flat_names(OBJECTS)))
        names = tuple(column.removesuffix('_u') for column in columns[::2])
        return names if object_columns(names) == columns else ()

    def _read_rows(self) -> list[dict[str, Any]]:
        """Return the rows of meta/episodes."""
        rows: list[dict[str, Any]] = []
        for file in sorted((self.folder / 'meta' / 'episodes').glob('*/*.parquet')):
            table = _read_parquet(file)
            rows += table.select(
                [name for name in table.column_names if not name.startswith('stats/')]).to_pylist()
        if not rows:
            raise RecordingError(f'{escaped(self.folder)}: meta/episodes holds no episode')
        return sorted(rows, key=lambda row: row['episode_index'])

    def _episode(self, row: dict[str, Any], crop: Crop, begin: int) -> Episode:
        """Return the episode of a row, its stamps from `begin` on."""
        path = self.folder / self._data_path.format(
            chunk_index=row['data/chunk_index'], file_index=row['data/file_index'])
        if self._file is None or self._file[0] != path:
            self._file = path, _read_parquet(path)
        table, index, T = self._file[1], row['episode_index'], row['length']
        part = table.slice(row['dataset_from_index'] - table['index'][0].as_py(), T)
        if len(part) != T or set(part['episode_index'].to_pylist()) != {index}:
            raise ValueError('its rows are not where meta/episodes says')
        is_video = self.features[self.camera]['dtype'] == 'video'
        pictures = self._decode(row, T) if is_video else map(
            self._picture, part[self.camera].to_pylist())
        frames = np.stack([crop.image(picture) for picture in pictures])

        def numbers(key: str, width: int) -> np.ndarray:
            return np.array(part[key].to_pylist(), np.float32).reshape(T, width)

        K = len(self._objects)
        pixels = numbers(OBJECTS, 2 * K) if K else np.empty((T, 0), np.float32)
        height, width = self.features[self.camera]['shape'][:2]
        actions = np.zeros((T, 4), np.float32)
        if self._is_ours(ACTION):  # nothing leads on from the last frame
            actions[:-1] = numbers(ACTION, 4)[:-1]
        poses, outcome = np.full((T, K, 7), np.nan), row.get(OUTCOME, '')
        return Episode(
            frames=frames, stamps=begin + (np.arange(T) * (1e9 / self.fps)).astype(np.int64),
            actions=actions, grippers=numbers(STATE, 4) if self._is_ours(STATE) else np.full(
                (T, 4), np.nan, np.float32),
            object_names=self._objects,
            object_pixels=crop.pixels(pixels.reshape(T, K, 2), (height, width)),
            object_poses=poses, goal_frame=None,
            goal_pixels=np.full((K, 2), np.nan, np.float32), goal_poses=poses[0],
            object_source='imported', task=str((row.get('tasks') or [''])[0]),
            seed=int(row.get(SEED, index)),
            outcome=outcome if outcome in OUTCOMES else '')

    def _picture(self, cell: Any) -> np.ndarray:
        """Return a picture of a row, uint8 (H, W, 3): bytes of a file, or the name of one."""
        data = cell.get('bytes') if isinstance(cell, dict) else None
        return decompress(data or (self.folder / str(cell['path'])).read_bytes(), 'unknown')

    def _decode(self, row: dict[str, Any], count: int) -> Iterator[np.ndarray]:
        """Yield frames of a video; episodes follow each other, so that none is searched for."""
        key = f'videos/{self.camera}/'
        path = self.folder / str(self._video_path).format(
            video_key=self.camera, chunk_index=row[key + 'chunk_index'],
            file_index=row[key + 'file_index'])
        first = round(row[key + 'from_timestamp'] * self.fps)
        if self._video is None or self._video[0] != path or self._video[2] > first:
            self._video = path, video_frames(path), 0
        _, frames, at = self._video
        for number in range(at, first + count):
            frame = next(frames, None)
            if frame is None:
                raise ValueError(f'{path}: ends before frame {number}')
            if number >= first:
                yield frame
        self._video = path, frames, first + count


def object_columns(names: tuple[str, ...]) -> list[str]:
    """Return the names of the numbers in OBJECTS: u and v of each object."""
    return [f'{name}_{axis}' for name in names for axis in 'uv']


def video_frames(path: Path) -> Iterator[np.ndarray]:
    """
    Decode a video: by OpenCV, or by PyAV where that cannot and PyAV is installed.

    :param path: of the file.
    :return: iterator over uint8 (H, W, 3) rgb.
    :raises ValueError: when it is not there, or its codec is unknown.
    """
    if not path.is_file():
        raise ValueError(f'{path} is not there')
    capture = cv2.VideoCapture(str(path))
    good, frame = capture.read()
    if good:
        while good:
            yield np.ascontiguousarray(frame[..., ::-1])
            good, frame = capture.read()
        return
    try:
        import av  # no dependency: its wheels hold GPL libraries
    except ImportError:
        raise ValueError(
            f'{path}: OpenCV knows no decoder for it, as for AV1; install PyAV (pip install av) '
            'if its licence suits you, or make it anew: ffmpeg -i OLD.mp4 -c:v libvpx-vp9 NEW.mp4'
        ) from None
    with av.open(str(path)) as container:
        for picture in container.decode(video=0):
            yield picture.to_ndarray(format='rgb24')


def _read_parquet(path: Path) -> Any:
    """Read a table."""
    import pyarrow
    from pyarrow import parquet
    try:
        return parquet.ParquetFile(path).read()
    except (OSError, pyarrow.ArrowException) as error:
        raise RecordingError(f'{escaped(path)}: cannot be read: {escaped(error, 200)}') from error
