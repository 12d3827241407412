# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import a LeRobotDataset of version 2 or 3 as recordings.

Pictures of one camera, the task as text, and where subtasks end, as marks. Actions, states and
objects only of sets that have ours: four numbers called dx, dy, dz and opening, and so on; of
other robots they would be an arm's command with another meaning, and are kept as signals.

In such a set meta/info.json describes it, and meta/episodes has a row an episode (v2: a line of
episodes.jsonl), data a row a frame. Pictures are files in the rows, or videos, of several episodes
(v2: of one), from which the frame nearest to a row's time is taken.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
import re
from typing import Annotated, Any
import warnings

import numpy as np
from tap_ros.base.contract import MAX_PICTURE_BYTES
from tap_ros.base.errors import ConfigError, RecordingError, RecordingWarning
from tap_ros.base.text import escaped, listing
from tap_ros.images.crop import Crop
from tap_ros.images.encodings import decompress
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode, OUTCOMES
from tap_ros.recording.formats.lerobot_format import (
    ACTION,
    cut_short,
    flat_names,
    INDICES,
    INFO,
    is_depth,
    listed,
    MOST_BYTES,
    NAMES,
    object_columns,
    OBJECTS,
    OUTCOME,
    read_parquet,
    SEED,
    signal_names,
    STATE,
    SUBTASK,
    Video,
)
from tap_ros.recording.formats.pictures import (
    DAMAGE,
    decoded,
    make_episode,
    Skipped,
    Target,
    write_bag,
)
from tap_ros.recording.formats.videos import at_rate, video_frames
from tap_ros.recording.marks import beside, write_marks
from tap_ros.recording.metadata import natural
from tap_ros.recording.trust import inside, parse_json, read_bytes
from tyro import conf

_OF_EPISODES = 'episode_index', 'length', 'tasks', 'dataset_from_index', SEED, OUTCOME
_LINES = 'meta/episodes.jsonl'
_MOST_EPISODES = 10**6  # of a set


@dataclass(frozen=True, kw_only=True)
class Options(Target):
    """
    Options of the command.

    :param path: folder of the data set, with meta/info.json.
    :param camera: feature whose pictures are taken; needed where the set has several of colour.
    """

    path: Annotated[conf.Positional[str], conf.arg(metavar='PATH')]
    camera: Annotated[str, conf.arg(metavar='FEATURE', help_behavior_hint=(
        '(default: the only one)'))] = ''


def run(args: Options) -> None:
    """
    Import, and print what was.

    :raises TapError: for a set that cannot be read, and a folder that holds something.
    """
    data = DataSet(args.path, args.camera)
    said = write_bag(args, data.episodes(args.cut, args.rate), data.skipped, len(data.rows),
                     jpeg=data.is_video and not args.size)
    print(f'{said} of {escaped(data.camera)}')
    if any(data.marks):
        path = beside(args.out)
        write_marks(path, open_recordings([args.out]), [args.out], {
            i: [(t, t) for t in frames] for i, frames in enumerate(data.marks) if frames})
        print(f'{escaped(path)}: marks where subtasks end, of '
              f'{sum(map(bool, data.marks))} episodes')
    if data.signals:
        print(f'signals: {listing(data.signals)}: {sum(map(len, data.signals.values()))} numbers')
    if data.unused:
        print(f'not taken: {listing(data.unused)}')


class DataSet:
    """
    A LeRobotDataset in a folder.

    :param folder: of the set.
    :param camera: feature whose pictures are taken; '': the only one of colour.
    :ivar rows: of meta/episodes, dicts in the order of the episodes, in the form of version 3.
    :ivar signals: names of the numbers of each feature that is kept as signals.
    :ivar unused: features that are not taken over.
    :ivar skipped: what could not be used so far.
    :ivar marks: of each episode so far the last frame of each subtask but the last one.
    :raises RecordingError: when it is none, or damaged.
    :raises ConfigError: for a camera that it has not, or has not alone.
    """

    def __init__(self, folder: str | Path, camera: str = '') -> None:
        self.folder = Path(folder)
        place = escaped(self.folder / INFO)
        try:
            info = parse_json(read_bytes(inside(self.folder, INFO), MOST_BYTES))
            version, self.fps = str(info['codebase_version']), float(info['fps'])
            self.features = dict(info['features'])
            self._data_path, self._video_path = str(info['data_path']), info.get('video_path')
            self._chunk, count = int(info.get('chunks_size') or 1000), int(
                info.get('total_episodes', 0))
            cameras = {name: feature for name, feature in self.features.items()
                       if feature['dtype'] in ('image', 'video')}
            colour = [name for name in cameras if not is_depth(self.features[name])]
            self._objects = self._object_names()
        except (OSError, RecordingError) as error:
            raise RecordingError(f'{escaped(self.folder)}: is no LeRobot data set: '
                                 f'{escaped(error)}') from error
        except DAMAGE as error:
            raise RecordingError(f'{place}: not the description of a LeRobot data set; it lacks '
                                 f'or garbles {escaped(error)}') from error
        if not version.startswith(('v2.', 'v3.')) or not 0 < self.fps <= 1e6:
            raise RecordingError(f'{escaped(self.folder)}: version {escaped(version, 20)}, '
                                 f'{self.fps} frames a second; expected v2 or v3')
        self._file: tuple[Path, Any] | None = None  # data file in memory
        self.skipped = Skipped()
        self.marks: list[list[int]] = []
        self.rows = self._read_rows(count)
        colour = [name for name in colour if not self._is_deep(name)]
        if camera not in cameras and (camera or len(colour) != 1):
            raise ConfigError(f'{escaped(self.folder)}: --camera: expected one of '
                              f'{listing(colour or cameras) or "its cameras, but there are none"}')
        self.camera = camera or colour[0]
        taken = {self.camera, 'timestamp', SUBTASK, *INDICES, *filter(self._is_ours, NAMES)}
        if self._objects:
            taken.add(OBJECTS)
        self.signals = signal_names(self.features, self.features.keys() - taken - cameras.keys())
        self.unused = sorted(self.features.keys() - taken - self.signals.keys())
        self._starts = self._find_starts() if self.is_video else {}
        self.rows = [row for row in self.rows
                     if row['episode_index'] in self._starts or not self.is_video]
        self._video: Video | None = None

    def episodes(self, crop: Crop, rate: float = 0.0) -> Iterator[Episode]:
        """
        Yield the episodes, without the rows whose pictures cannot be used.

        :param crop: Crop of the pictures.
        :param rate: rows a second that are taken, about; 0: all.
        """
        for row in self.rows:
            with self.skipped.errors_of('episode', escaped(row['episode_index'], 20)):
                yield self._episode(row, crop, rate)

    @property
    def is_video(self) -> bool:
        """Whether the pictures are in videos, not in files."""
        return bool(self.features[self.camera]['dtype'] == 'video')

    def _is_ours(self, key: str) -> bool:
        """Return whether the numbers of a feature mean what they do in our recordings."""
        return flat_names(self.features.get(key)) == NAMES[key]

    def _object_names(self) -> tuple[str, ...]:
        """Return the objects whose pixels the set has as we export them."""
        columns = list(map(str, flat_names(self.features.get(OBJECTS))))
        names = tuple(column.removesuffix('_u') for column in columns[::2])
        return tuple(map(escaped, names)) if object_columns(names) == columns else ()

    def _read_rows(self, count: int) -> list[dict[str, Any]]:
        """Return the rows of meta/episodes, or the lines of episodes.jsonl, of so many."""
        found: list[Any] = []
        for file in sorted((self.folder / 'meta' / 'episodes').glob('*/*.parquet'), key=natural):
            with self.skipped.errors_of('file', f'meta/episodes/{escaped(file.name)}'):
                table = read_parquet(self.folder, file.relative_to(self.folder))
                for part in table.select([name for name in table.column_names if name.startswith(
                        (*_OF_EPISODES, 'data/', 'videos/'))]).to_batches():
                    found += map(cut_short, listed(part))
        if not found and (self.folder / _LINES).exists():
            with self.skipped.errors_of('file', _LINES):
                found = read_bytes(inside(self.folder, _LINES), MOST_BYTES).splitlines()
        rows: list[dict[str, Any]] = []
        for number, one in enumerate(filter(None, found[:_MOST_EPISODES])):
            with self.skipped.errors_of('row', f'{number} of meta/episodes'):
                row = parse_json(one) if isinstance(one, bytes) else one
                row = cut_short(row) | {
                    name: int(row[name]) for name in ('episode_index', 'length')}
                if min(row['episode_index'], row['length'] - 1) < 0:
                    raise ValueError('it counts below zero')
                rows.append(row)
        rows.sort(key=lambda row: (row['episode_index'], row['length']))
        if not rows:
            raise RecordingError(f'{escaped(self.folder)}: meta/episodes holds no episode')
        if len(rows) < count:
            self.skipped.note(f'meta/episodes tells of {len(rows)} of {count} episodes', '', '')
        return rows

    def _is_deep(self, camera: str) -> bool:
        """Tell whether the pictures of a feature have 16 bits a pixel, as of depth."""
        if self.features[camera]['dtype'] == 'video':
            return False
        with suppress(*DAMAGE):
            data = self._file_of(self._rows_of(self.rows[0])[camera][0].as_py())
            return data.startswith(b'\x89PNG') and data[24] == 16
        return False

    def _path(self, pattern: object, row: dict[str, Any], part: str) -> Path:
        """Return the name of a file of an episode; part is data, or videos/ and the camera."""
        index = row['episode_index']
        values = {'video_key': self.camera, 'episode_index': index,
                  'episode_chunk': index // self._chunk, **{
                      name: int(row.get(f'{part}/{name}', 0))
                      for name in ('chunk_index', 'file_index')}}
        return Path(re.sub(  # not str.format, which a pattern can make do much else
            r'[{](\w+)(?::0(\d)d)?[}]',
            lambda match: str(values[match[1]]).zfill(int(match[2] or 0)), str(pattern)))

    def _rows_of(self, row: dict[str, Any]) -> Any:
        """Return the rows of an episode as a table."""
        path = self._path(self._data_path, row, 'data')
        if self._file is None or self._file[0] != path:
            self._file = None  # before another one is in memory
            self._file = path, read_parquet(self.folder, path)
        table, T = self._file[1], row['length']
        first = table['index'][0].as_py()
        part = table.slice(row.get('dataset_from_index', first) - first, T)
        if len(part) != T or set(listed(part['episode_index'])) != {row['episode_index']}:
            raise ValueError('its rows are not where meta/episodes says')
        return part

    def _find_starts(self) -> dict[int, float]:
        """Return where in its video each episode begins, in seconds; episodes cannot overlap."""
        starts: dict[int, float] = {}
        ends: dict[Path, float] = {}  # of the episodes so far
        overlaps = 0
        for row in self.rows:
            with self.skipped.errors_of('episode', str(row['episode_index'])):
                path = self._path(self._video_path, row, f'videos/{self.camera}')
                told = float(row.get(f'videos/{self.camera}/from_timestamp', 0.0))
                if not 0 <= told < 1e6:
                    raise ValueError(f'it begins at {told:g} s of its video')
                free = ends.get(path, told)
                is_within = told < free - 0.5 / self.fps
                overlaps += is_within
                starts[row['episode_index']] = start = free if is_within else told
                ends[path] = start + row['length'] / self.fps
        if overlaps:
            warnings.warn(f'{escaped(self.folder)}: {overlaps} episodes begin, by their '
                          'from_timestamp, within the one before; they are taken one after the '
                          'other', RecordingWarning, stacklevel=3)
        return starts

    def _episode(self, row: dict[str, Any], crop: Crop, rate: float) -> Episode:
        """Return the episode of a row."""
        part, size, number = self._rows_of(row), (1, 1), row['episode_index']
        seconds = np.arange(len(part)) / self.fps
        told = np.array(listed(part['timestamp']), float).ravel()
        if (np.abs(told - told[0] - seconds) > 0.5 / self.fps).any() and (np.diff(told) > 0).all():
            seconds = told - told[0]  # another rate than that of the description
        taken = [row for _, row in at_rate(zip(seconds.tolist(), range(len(part))), rate)]
        whole, part, seconds = len(taken) == len(part), part.take(taken), seconds[taken]
        cells, show = self._filmed(row, part) if self.is_video else (
            part[self.camera],  # rows may share what is in the file once
            lambda cell: decompress(self._file_of(cell.as_py()), 'unknown'))

        def decode(cell: Any) -> np.ndarray:
            nonlocal size
            picture = show(cell)
            size = picture.shape[:2]
            return crop.image(picture)

        frames, kept = decoded(enumerate(cells), decode, self.skipped, f'episode {number}')
        T = len(kept)

        def numbers(key: str, width: int) -> np.ndarray:
            values = np.array(listed(part[key]), np.float32).reshape(-1, width)
            if len(values) != len(part):
                raise ValueError(f'{escaped(key, 60)} has not {width} numbers a row')
            return values[kept]

        known: dict[str, Any] = {}
        if self._objects:
            pixels = numbers(OBJECTS, 2 * len(self._objects)).reshape(T, -1, 2)
            known['object_pixels'] = crop.pixels(pixels, size)
        if self._is_ours(ACTION) and whole:  # nothing leads on from the last frame
            known['actions'] = np.append(numbers(ACTION, 4)[:-1], np.zeros((1, 4), np.float32), 0)
        if self._is_ours(STATE):
            known['grippers'] = numbers(STATE, 4)
        for key, own in self.signals.items():
            with self.skipped.errors_of('signal', f'{escaped(key, 60)} of episode {number}'):
                known['signals'] = np.concatenate([
                    known.get('signals', np.empty((T, 0), np.float32)), numbers(key, len(own))], 1)
                known['signal_names'] = known.get('signal_names', ()) + tuple(own)
        outcome = row.get(OUTCOME, '')
        self.marks.append([])
        if SUBTASK in self.features:
            ends = np.flatnonzero(np.diff(np.ravel(listed(part[SUBTASK]))[kept]))
            self.marks[-1] = ends[ends > 0].tolist()
        return make_episode(
            frames, seconds[kept], self._objects,
            task=row['tasks'], seed=int(row.get(SEED, row['episode_index'])),
            outcome=outcome if outcome in OUTCOMES else '', **known)

    def _file_of(self, cell: Any) -> bytes:
        """Return the picture file of a row: its bytes, or what has its name."""
        data = cell.get('bytes') if isinstance(cell, dict) else None
        return data if isinstance(data, bytes) and data else read_bytes(
            inside(self.folder, str(cell['path'])), MAX_PICTURE_BYTES)

    def _filmed(self, row: dict[str, Any],
                part: Any) -> tuple[list[float], Callable[[float], np.ndarray]]:
        """Return the time of each row in a video, and what returns the frame of a time."""
        path = self._path(self._video_path, row, f'videos/{self.camera}')
        times = self._starts[row['episode_index']] + np.array(
            listed(part['timestamp']), float).ravel()
        if self._video is None or self._video.path != path or self._video.now[0] > times[0]:
            self._video = Video(path, video_frames(inside(self.folder, path)), 1 / self.fps)
        video = self._video

        def show(at: float) -> np.ndarray:
            seen, picture = video.at(at)
            if picture is None or not abs(seen - at) <= 1 / self.fps:  # nor for NaN
                raise RecordingError(f'{escaped(path)} has no frame at {at:.3f} s')
            return picture
        return times.tolist(), show
