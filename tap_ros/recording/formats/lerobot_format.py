# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a LeRobotDataset is made of: names, tables and videos."""

from collections.abc import Iterable, Iterator, Mapping
import json
from pathlib import Path
import re
from typing import Any

import numpy as np
from tap_ros.base.contract import GRIPPER_JOINTS, MOST_SIGNALS
from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.recording.bags import what_else
from tap_ros.recording.formats.pictures import DAMAGE, MOST_CHARACTERS
from tap_ros.recording.formats.videos import Show
from tap_ros.recording.trust import Budget, inside

INFO = 'meta/info.json'
CAMERA = 'observation.images.camera'
STATE, OBJECTS, ACTION = 'observation.state', 'observation.environment_state', 'action'
NAMES = {ACTION: ['dx', 'dy', 'dz', 'opening'], STATE: list(GRIPPER_JOINTS)}  # of our numbers
INDICES = ('frame_index', 'episode_index', 'index', 'task_index')  # columns that all sets have
SUBTASK = 'subtask_index'  # column of the sets that have meta/subtasks.parquet, too
SEED, OUTCOME = 'tap_ros/seed', 'tap_ros/outcome'  # columns of ours beside LeRobot's
INDEX = {'dtype': 'int64', 'shape': [1], 'names': None}  # feature of a column of numbers
MOST_BYTES, _MOST_ROWS = 2**26, 10**7  # of JSON, of a table
_BATCH = 256  # rows that are read at once


def object_columns(names: tuple[str, ...]) -> list[str]:
    """Return the names of the numbers in OBJECTS: u and v of each object."""
    return [f'{name}_{axis}' for name in names for axis in 'uv']


def flat_names(feature: Mapping[str, Any] | None) -> list[Any]:
    """Return the names of a feature's numbers; some sets have them in lists, a dict, or none."""
    names = (feature or {}).get('names')
    parts = names.values() if isinstance(names, dict) else names if isinstance(names, list) else []
    return [name for part in parts for name in (part if isinstance(part, list) else [part])]


def signal_names(features: Mapping[str, Any], chosen: Iterable[str]) -> dict[str, list[str]]:
    """
    Return the names of the numbers in each feature that has some, MOST_SIGNALS at most.

    :param features: of meta/info.json.
    :param chosen: names of those that may be taken.
    """
    found: dict[str, list[str]] = {}
    for key in sorted(chosen):
        shape, kind = features[key].get('shape'), str(features[key].get('dtype'))
        if not re.fullmatch(r'(float|u?int)\d+|bool', kind) or not isinstance(
                shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
            continue
        count, names = shape[0], flat_names(features[key])
        names = names if len(names) == count else list(range(min(count, MOST_SIGNALS + 1)))
        own = [f'{key}/{escaped(name, 60)}' if count > 1 else key for name in names]
        if 0 < len(own) == len(set(own)) <= MOST_SIGNALS - sum(map(len, found.values())):
            found[key] = own
    return found


def is_depth(feature: dict[str, Any]) -> bool:
    """Return whether a feature is of depth by its description."""
    about = feature.get('info') or {}
    return any(about.get(name) for name in ('video.is_depth_map', 'is_depth_map'))


def cut_short(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of meta/episodes with the beginning of its task alone, as text."""
    tasks = row.get('tasks')
    return row | {'tasks': str(tasks[0] if isinstance(tasks, list) and tasks else tasks or '')[
        :MOST_CHARACTERS]}


def names_table(key: str, numbers: Mapping[str, int]) -> Any:
    """Return numbers as pandas writes them, with the names as index: LeRobot uses pandas."""
    import pyarrow
    table = pyarrow.table({f'{key}_index': list(numbers.values()), key: list(numbers)})
    described = {'index_columns': [key], 'column_indexes': [], 'columns': [
        {'name': f'{key}_index', 'field_name': f'{key}_index', 'pandas_type': 'int64',
         'numpy_type': 'int64', 'metadata': None},
        {'name': key, 'field_name': key, 'pandas_type': 'unicode', 'numpy_type': 'object',
         'metadata': None}]}
    return table.replace_schema_metadata({'pandas': json.dumps(described)})


def listed(values: Any) -> list[Any]:
    """
    Return what a table holds as Python's values, which take far more memory.

    :raises ValueError: for more than descriptions and numbers have.
    """
    if max(values.nbytes, _count(values)) > MOST_BYTES or 'dictionary' in str(
            getattr(values, 'schema', None) or values.type):  # whose values repeat
        raise ValueError('its columns hold more than numbers and names')
    return list(values.to_pylist())


def _count(values: Any) -> int:
    """Return how many values there are at any depth; nulls in lists take no bytes."""
    if hasattr(values, 'schema') or hasattr(values, 'chunks'):
        return sum(map(_count, values.columns if hasattr(values, 'schema') else values.chunks))
    inner = values.flatten() if hasattr(values, 'flatten') else []
    return len(values) + sum(map(_count, inner if isinstance(inner, list) else [inner]))


def read_parquet(folder: Path, name: Path) -> Any:
    """
    Read a table of a set, in parts, as a short file can hold a long one.

    :raises RecordingError: when it cannot be read.
    """
    import pyarrow
    from pyarrow import parquet
    path = inside(folder, name)
    try:
        with parquet.ParquetFile(path) as file:
            if file.metadata.num_rows > _MOST_ROWS:
                raise ValueError(f'it has more than {_MOST_ROWS} rows')
            budget, parts = Budget(path.stat().st_size), []
            for part in file.iter_batches(_BATCH):
                budget.take(part.nbytes)
                parts.append(part)
            return pyarrow.Table.from_batches(parts)
    except (*DAMAGE, pyarrow.ArrowException) as error:
        why = what_else(path) or f'cannot be read: {escaped(error, 200)}'
        raise RecordingError(f'{escaped(name)}: {why}') from error


class Video:
    """
    A video from which frames are taken one after the other, by their times.

    :param path: its name in the set.
    :param frames: as video_frames yields them.
    :param period: s; a frame may be so far from the time for which it is asked.
    :ivar now: (seconds, picture or None) of the frame that was taken last.
    """

    def __init__(self, path: Path, frames: Iterator[tuple[float, Show]], period: float) -> None:
        self.path, self._frames, self._period = path, frames, period
        first = next(frames, None)
        if not first:
            raise RecordingError(f'{escaped(path)} has no frame')
        self.now: tuple[float, np.ndarray | None] = first[0], first[1]()
        self._next = next(frames, None)

    def at(self, seconds: float) -> tuple[float, np.ndarray | None]:
        """
        Return the frame nearest to a time, of those not before the last one.

        :return: its time, and the picture; None of one more than a period away.
        """
        while self._next and abs(self._next[0] - seconds) <= abs(self.now[0] - seconds):
            at, show = self._next  # it is shown, if at all, before the next one is asked for
            self.now = at, show() if at >= seconds - 1.5 * self._period else None
            self._next = next(self._frames, None)
        return self.now
