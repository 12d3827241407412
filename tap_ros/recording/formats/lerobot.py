# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Import a LeRobotDataset of version 2 or 3 as recordings.

Pictures of one camera or several, the task as text, and where the next subtask begins, as marks.
Actions, states and objects only of sets that have ours: four numbers called dx, dy, dz and
opening, and so on; of other robots they would be an arm's command with another meaning, and are
kept as signals.

In such a set meta/info.json describes it, and meta/episodes has a row an episode (v2: a line of
episodes.jsonl), data a row a frame. Pictures are files in the rows, or videos, of several episodes
(v2: of one), from which the frame nearest to a row's time is taken.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.options import check_different
from tap_ros.base.text import counted, escaped, listing
from tap_ros.images.crop import Crop
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode, OUTCOMES
from tap_ros.recording.formats.lerobot_camera import Camera, path_in, picture_file
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
)
from tap_ros.recording.formats.other_cameras import print_views, view_names
from tap_ros.recording.formats.pictures import (
    DAMAGE,
    decoded,
    make_episode,
    print_signals,
    Skipped,
    Target,
    write_bag,
)
from tap_ros.recording.formats.videos import at_rate
from tap_ros.recording.marks import beside, write_marks
from tap_ros.recording.metadata import natural
from tap_ros.recording.trust import inside, parse_json, read_bytes
from tap_ros.recording.writer import Views
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
        Given several times, the first is the predictor's, on /camera/image_raw; each other one is
        kept for label, on a topic such as /camera/wrist/image_raw.
    """

    path: Annotated[conf.Positional[str], conf.arg(metavar='PATH')]
    camera: conf.UseAppendAction[Annotated[tuple[str, ...], conf.arg(
        metavar='FEATURE', help_behavior_hint='(default: the only one)')]] = ()


def run(args: Options) -> None:
    """
    Import, and print what was.

    :raises TapError: for a set that cannot be read, and a folder that holds something.
    """
    data = DataSet(args.path, *args.camera)
    said = write_bag(args, data.episodes(args.cut, args.rate), data.skipped, len(data.rows),
                     jpeg=data.is_video(data.camera) and not args.size)
    print(f'{said} of {escaped(data.camera)}')
    print_views(data.others)
    if any(data.marks):
        path = beside(args.out)
        write_marks(path, open_recordings([args.out]), [args.out], {
            i: [(t, t) for t in frames] for i, frames in enumerate(data.marks) if frames})
        print(f'{escaped(path)}: marks where the next subtask begins, of '
              f'{counted(sum(map(bool, data.marks)), "episode")}')
    print_signals(data.signals, sum(map(len, data.signals.values())))
    if data.unused:
        print(f'not taken: {listing(data.unused)}')


class DataSet:
    """
    A LeRobotDataset in a folder.

    :param folder: of the set.
    :param chosen: features whose pictures are taken; none: the only one of colour.
    :ivar camera: the first of these.
    :ivar others: a Camera of each other one, by the name that its topic gets.
    :ivar rows: of meta/episodes, dicts in the order of the episodes, in the form of version 3.
    :ivar signals: names of the numbers of each feature that is kept as signals.
    :ivar unused: features that are not taken over.
    :ivar skipped: what could not be used so far.
    :ivar marks: of each episode so far the first frame of each subtask but the first one.
    :raises RecordingError: when it is none, or damaged.
    :raises ConfigError: for a camera that it has not, or has not alone.
    """

    def __init__(self, folder: str | Path, *chosen: str) -> None:
        self.folder = Path(folder)
        place = escaped(self.folder / INFO)
        try:
            info = parse_json(read_bytes(inside(self.folder, INFO), MOST_BYTES))
            version, self.fps = str(info['codebase_version']), float(info['fps'])
            self.features = dict(info['features'])
            self._data_path, count = str(info['data_path']), int(info.get('total_episodes', 0))
            self._chunk = int(info.get('chunks_size') or 1000)
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
        check_different('--camera', chosen)
        keys = list(chosen)
        if not cameras.keys() >= {*keys} or not keys and len(colour) != 1:
            raise ConfigError(f'{escaped(self.folder)}: --camera: expected one of '
                              f'{listing(colour or cameras) or "its cameras, but there are none"}')
        keys = keys or colour
        taken = {*keys, 'timestamp', SUBTASK, *INDICES, *filter(self._is_ours, NAMES)}
        if self._objects:
            taken.add(OBJECTS)
        self.signals = signal_names(self.features, self.features.keys() - taken - cameras.keys())
        self.unused = sorted(self.features.keys() - taken - self.signals.keys())
        self._camera, *views = (Camera(self.folder, key, self.fps, partial(
            path_in, info.get('video_path'), part=f'videos/{key}', chunk=self._chunk,
        ) if self.is_video(key) else None) for key in keys)
        self.camera, self.others = keys[0], dict(zip(view_names(keys[1:]), views, strict=True))
        self.rows = self._camera.find_starts(self.rows, self.skipped)
        for one in views:
            one.find_starts(self.rows, self.skipped)

    def episodes(self, crop: Crop, rate: float = 0.0) -> Iterator[tuple[Episode, Views]]:
        """
        Yield the episodes, without the rows whose pictures cannot be used, and the other views.

        :param crop: Crop of the pictures.
        :param rate: rows a second that are taken, about; 0: all.
        """
        for row in self.rows:
            with self.skipped.errors_of('episode', escaped(row['episode_index'], 20)):
                yield self._episode(row, crop, rate)

    def is_video(self, key: str) -> bool:
        """Return whether the pictures of a camera are in videos, not in files."""
        return bool(self.features[key]['dtype'] == 'video')

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
        """Return whether the pictures of a feature have 16 bits a pixel, as of depth."""
        if self.is_video(camera):
            return False
        with suppress(*DAMAGE):
            data = picture_file(self.folder, self._rows_of(self.rows[0])[camera][0].as_py())
            return data.startswith(b'\x89PNG') and data[24] == 16
        return False

    def _rows_of(self, row: dict[str, Any]) -> Any:
        """Return the rows of an episode as a table."""
        path = path_in(self._data_path, row, 'data', self._chunk)
        if self._file is None or self._file[0] != path:
            self._file = None  # before another one is in memory
            self._file = path, read_parquet(self.folder, path)
        table, T = self._file[1], row['length']
        first = table['index'][0].as_py()
        part = table.slice(row.get('dataset_from_index', first) - first, T)
        if len(part) != T or set(listed(part['episode_index'])) != {row['episode_index']}:
            raise ValueError('its rows are not where meta/episodes says')
        return part

    def _episode(self, row: dict[str, Any], crop: Crop, rate: float) -> tuple[Episode, Views]:
        """Return the episode of a row, and what other cameras saw, decoded when it is asked."""
        part, size, number = self._rows_of(row), (1, 1), row['episode_index']
        seconds = np.arange(len(part)) / self.fps
        told = np.array(listed(part['timestamp']), float).ravel()
        if (np.abs(told - told[0] - seconds) > 0.5 / self.fps).any() and (np.diff(told) > 0).all():
            seconds = told - told[0]  # another rate than that of the description
        taken = [row for _, row in at_rate(zip(seconds.tolist(), range(len(part))), rate)]
        whole, part, seconds = len(taken) == len(part), part.take(taken), seconds[taken]
        cells, show = self._camera.cells(row, part)

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
            begun = 1 + np.flatnonzero(np.diff(np.ravel(listed(part[SUBTASK]))[kept]))
            self.marks[-1] = begun[begun < T - 1].tolist()  # the goal is no moment before it
        episode = make_episode(
            frames, seconds[kept], self._objects,
            task=row['tasks'], seed=int(row.get(SEED, row['episode_index'])),
            outcome=outcome if outcome in OUTCOMES else '', **known)
        return episode, {name: one.view(row, part, kept.tolist(), crop, self.skipped)
                         for name, one in self.others.items()}
