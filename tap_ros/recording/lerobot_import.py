# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import a LeRobotDataset v3.0 as recordings.

Pictures of one camera, and the task as text. Actions, states and objects only of sets that have
ours: four numbers called dx, dy, dz and opening, and so on; of other robots they would be an arm's
command with another meaning.
"""

from collections.abc import Iterator
from dataclasses import dataclass
import io
import json
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError
from tap_ros.contract import MAX_PICTURE_BYTES
from tap_ros.errors import ConfigError, ImageError, RecordingError
from tap_ros.files import only_writer
from tap_ros.images.crop import Crop
from tap_ros.options import Folder
from tap_ros.recording import lerobot
from tap_ros.recording.episode import Episode, OUTCOMES
from tap_ros.recording.reading_options import Part
from tap_ros.recording.writer import EpisodeWriter, write_metadata
from tap_ros.text import escaped, listing
from tqdm import tqdm
from tyro import conf

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
    out.mkdir(parents=True, exist_ok=True)
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
        info = _read_json(self.folder / lerobot.INFO)
        try:
            version, self.fps = str(info['codebase_version']), float(info['fps'])
            self.features = dict(info['features'])
            self._data_path, self._video_path = str(info['data_path']), info.get('video_path')
            cameras = [name for name, feature in self.features.items()
                       if feature['dtype'] in ('image', 'video')]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecordingError(f'{escaped(self.folder / lerobot.INFO)}: lacks or garbles '
                                 f'{escaped(error)}') from error
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
        self._is_video = self.features[self.camera]['dtype'] == 'video'
        names = {key: lerobot.flat_names(self.features[key]) if key in self.features else []
                 for key in (lerobot.ACTION, lerobot.STATE, lerobot.OBJECTS)}
        self._acts = names[lerobot.ACTION] == list(lerobot.ACTION_NAMES)
        self._states = names[lerobot.STATE] == list(lerobot.STATE_NAMES)
        self._objects = lerobot.object_names(names[lerobot.OBJECTS]) or ()
        taken = {self.camera, 'timestamp', 'frame_index', 'episode_index', 'index', 'task_index',
                 *([lerobot.ACTION] if self._acts else []),
                 *([lerobot.STATE] if self._states else []),
                 *([lerobot.OBJECTS] if self._objects else [])}
        self.unused = sorted(set(self.features) - taken)
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
            episode = self._episode(row, crop, begin)
            begin = int(episode.stamps[-1]) + EPISODE_SPACING_NS
            yield episode

    def _read_rows(self) -> list[dict[str, Any]]:
        """Return the rows of meta/episodes."""
        files = sorted((self.folder / 'meta' / 'episodes').glob('*/*.parquet'))
        rows: list[dict[str, Any]] = []
        for file in files:
            table = _read_parquet(file)
            rows += table.select(
                [name for name in table.column_names if not name.startswith('stats/')]).to_pylist()
        if not rows:
            raise RecordingError(f'{escaped(self.folder)}: meta/episodes holds no episode')
        return sorted(rows, key=lambda row: row['episode_index'])

    def _episode(self, row: dict[str, Any], crop: Crop, begin: int) -> Episode:
        """Return the episode of a row, its stamps from `begin` on."""
        index = row['episode_index']
        try:
            path = self.folder / self._data_path.format(
                chunk_index=row['data/chunk_index'], file_index=row['data/file_index'])
            table = self._table(path)
            offset = row['dataset_from_index'] - table['index'][0].as_py()
            part = table.slice(offset, row['length'])
            if len(part) != row['length'] or set(
                    part['episode_index'].to_pylist()) != {index}:
                raise ValueError('its rows are not where meta/episodes says')
            frames = self._frames(row, part, crop)
            T, K = len(frames), len(self._objects)
            tasks = row.get('tasks') or ['']
            outcome = row.get(lerobot.OUTCOME, '')
            unknown = np.full((T, K, 7), np.nan)
            return Episode(
                frames=frames,
                stamps=begin + (np.arange(T) * (1e9 / self.fps)).astype(np.int64),
                actions=self._actions(part), grippers=self._numbers(
                    part, lerobot.STATE, 4) if self._states else np.full(
                        (T, 4), np.nan, np.float32),
                object_names=self._objects,
                object_pixels=self._pixels(part, crop),
                object_poses=unknown, goal_frame=None,
                goal_pixels=np.full((K, 2), np.nan, np.float32), goal_poses=unknown[0],
                task=str(tasks[0]), seed=int(row.get(lerobot.SEED, index)),
                outcome=outcome if outcome in OUTCOMES else '')
        except (KeyError, TypeError, ValueError, IndexError, ImageError, OSError) as error:
            raise RecordingError(f'{escaped(self.folder)}: episode {escaped(index, 20)} cannot be '
                                 f'read: {escaped(error, 200)}') from error

    def _table(self, path: Path) -> Any:
        """Return the rows of a data file; the last one is kept."""
        if self._file is None or self._file[0] != path:
            self._file = path, _read_parquet(path)
        return self._file[1]

    def _frames(self, row: dict[str, Any], part: Any, crop: Crop) -> np.ndarray:
        """Return the pictures of an episode, (T, H, W, 3)."""
        if self._is_video:
            found = self._decode(row, len(part))
        else:
            found = (_picture(cell, self.folder) for cell in part[self.camera].to_pylist())
        return np.stack([crop.image(frame) for frame in found])

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

    def _numbers(self, part: Any, key: str, width: int) -> np.ndarray:
        """Return the numbers of a column, (T, width) float32."""
        values = np.array(part[key].to_pylist(), np.float32).reshape(len(part), -1)
        if values.shape[1] != width:
            raise ValueError(f'{key} has {values.shape[1]} numbers, not {width}')
        return values

    def _actions(self, part: Any) -> np.ndarray:
        """Return the actions, (T, 4); nothing leads on from the last frame."""
        if not self._acts:
            return np.zeros((len(part), 4), np.float32)
        actions = self._numbers(part, lerobot.ACTION, 4)
        actions[-1] = 0
        return actions

    def _pixels(self, part: Any, crop: Crop) -> np.ndarray:
        """Return the pixels of the objects, (T, K, 2), in the part of the picture that is kept."""
        T, K = len(part), len(self._objects)
        pixels = self._numbers(part, lerobot.OBJECTS, 2 * K) if K else np.empty((T, 0), np.float32)
        height, width = self.features[self.camera]['shape'][:2]
        return crop.pixels(pixels.reshape(T, K, 2), (height, width))


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


def _picture(cell: Any, folder: Path) -> np.ndarray:
    """Return a picture of a row, uint8 (H, W, 3): bytes of a file, or the name of one."""
    data = cell.get('bytes') if isinstance(cell, dict) else None
    source: Any = io.BytesIO(data) if data else folder / str(cell['path'])
    try:
        with Image.open(source, formats=('PNG', 'JPEG', 'WEBP')) as file:
            if file.size[0] * file.size[1] * 3 > MAX_PICTURE_BYTES:
                raise ValueError('a picture of {}x{} pixels is too large'.format(*file.size))
            return np.array(file.convert('RGB'))
    except (UnidentifiedImageError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f'a picture that cannot be read: {error}') from error


def _read_json(path: Path) -> dict[str, Any]:
    """Read info.json."""
    try:
        with open(path, 'rb') as stream:
            found = json.loads(stream.read(_INFO_BYTES))
        if isinstance(found, dict):
            return found
        reason = 'it holds no object'
    except OSError as error:
        reason = str(error.strerror)
    except ValueError as error:
        reason = escaped(error)
    raise RecordingError(f'{escaped(path)}: not the description of a LeRobot data set: {reason}')


def _read_parquet(path: Path) -> Any:
    """Read a table."""
    import pyarrow
    from pyarrow import parquet
    try:
        return parquet.ParquetFile(path).read()
    except (OSError, pyarrow.ArrowException) as error:
        raise RecordingError(f'{escaped(path)}: cannot be read: {escaped(error, 200)}') from error
