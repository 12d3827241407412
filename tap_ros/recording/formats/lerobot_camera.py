# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of one camera of a LeRobotDataset: files in its rows, or videos of its episodes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
import re
from typing import Any
import warnings

import numpy as np
from tap_ros.base.contract import MAX_PICTURE_BYTES
from tap_ros.base.errors import RecordingError, RecordingWarning
from tap_ros.base.text import escaped
from tap_ros.images.crop import Crop
from tap_ros.images.encodings import decompress
from tap_ros.recording.formats.lerobot_format import listed, Video
from tap_ros.recording.formats.pictures import Skipped
from tap_ros.recording.formats.videos import video_frames
from tap_ros.recording.trust import inside, MOST_BYTES, read_bytes

Row = dict[str, Any]  # of meta/episodes


class Camera:
    """
    A camera of a data set.

    :param folder: of the set.
    :param key: feature of its pictures.
    :param fps: frames a second.
    :param path_of: what returns the name of the video that an episode is in; None: of files.
    :ivar count: pictures that `view` has shown so far.
    """

    def __init__(self, folder: Path, key: str, fps: float,
                 path_of: Callable[[Row], Path] | None) -> None:
        self.folder, self.key, self.fps, self.count = folder, key, fps, 0
        self._path_of = path_of
        self._starts: dict[int, float] = {}
        self._video: Video | None = None

    def find_starts(self, rows: Iterable[Row], skipped: Skipped) -> list[Row]:
        """
        Find where in its video each episode begins, in seconds; episodes cannot overlap.

        :param skipped: is told of those whose beginning nothing tells.
        :return: the others.
        """
        if not self._path_of:
            return list(rows)
        found: list[Row] = []
        ends: dict[Path, float] = {}  # of the episodes so far
        overlaps = 0
        for row in rows:
            with skipped.errors_of('episode', self._named(row)):
                path = self._path_of(row)
                told = float(row.get(f'videos/{self.key}/from_timestamp', 0.0))
                if not 0 <= told < 1e6:
                    raise ValueError(f'it begins at {told:g} s of its video')
                free = ends.get(path, told)
                is_within = told < free - 0.5 / self.fps
                overlaps += is_within
                self._starts[row['episode_index']] = start = free if is_within else told
                ends[path] = start + row['length'] / self.fps
                found.append(row)
        if overlaps:
            warnings.warn(f'{escaped(self.folder)}: {overlaps} episodes begin, by their '
                          'from_timestamp, within the one before; they are taken one after the '
                          'other', RecordingWarning, stacklevel=4)
        return found

    def cells(self, row: Row, part: Any) -> tuple[Sequence[Any], Callable[[Any], np.ndarray]]:
        """
        Return what tells of the pictures of some rows, and what makes a picture of one of these.

        :param row: of the episode.
        :param part: its rows, a table.
        """
        if not self._path_of:  # rows may share what is in the file once
            return part[self.key], lambda cell: decompress(
                picture_file(self.folder, cell.as_py()), 'unknown')
        path = self._path_of(row)
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

    def view(self, row: Row, part: Any, kept: Iterable[int], crop: Crop,
             skipped: Skipped) -> Iterator[np.ndarray | None]:
        """
        Yield the pictures of rows that another camera keeps, one at a time; None of no use.

        :param row, part: as `cells` takes them.
        :param kept: which rows of the part.
        """
        place, size = f'episode {self._named(row)}', 0
        if self._path_of and row['episode_index'] not in self._starts:
            return  # of which find_starts told
        with skipped.errors_of('view', place):
            cells, show = self.cells(row, part)
            for k in kept:
                picture = None
                with skipped.errors_of('picture', f'{k} of {place}'):
                    picture = crop.image(show(cells[k]))
                    size += picture.nbytes
                if size > MOST_BYTES:
                    raise RecordingError(f'it has more than {MOST_BYTES >> 30} GiB; keep less of '
                                         'each picture (--size)')
                self.count += picture is not None
                yield picture

    def _named(self, row: Row) -> str:
        return f'{escaped(row["episode_index"], 20)} of {escaped(self.key, 60)}'


def picture_file(folder: Path, cell: Any) -> bytes:
    """Return the picture file of a row: its bytes, or what has its name."""
    data = cell.get('bytes') if isinstance(cell, dict) else None
    return data if isinstance(data, bytes) and data else read_bytes(
        inside(folder, str(cell['path'])), MAX_PICTURE_BYTES)


def path_in(pattern: object, row: Row, part: str, chunk: int) -> Path:
    """
    Return the name of a file of an episode.

    :param pattern: as meta/info.json tells it.
    :param part: data, or videos/ and the camera.
    :param chunk: files a folder, of version 2.
    """
    index = row['episode_index']
    values = {'video_key': part.removeprefix('videos/'), 'episode_index': index,
              'episode_chunk': index // chunk, **{
                  name: int(row.get(f'{part}/{name}', 0))
                  for name in ('chunk_index', 'file_index')}}
    return Path(re.sub(  # not str.format, which a pattern can make do much else
        r'[{](\w+)(?::0(\d)d)?[}]',
        lambda match: str(values[match[1]]).zfill(int(match[2] or 0)), str(pattern)))
