# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The layout of LeRobotDataset v3.0: names of files and columns, and what of an episode they hold.

meta/info.json, stats.json and tasks.parquet describe a set; meta/episodes has a row an episode,
data a row a frame. Pictures are PNG files in the rows, or videos of several episodes.
"""

from collections.abc import Iterator
from typing import Any

from tap_ros.contract import GRIPPER_JOINTS

VERSION = 'v3.0'
FILES_PER_CHUNK = 1000
FILE_PATTERN = 'chunk-{chunk_index:03d}/file-{file_index:03d}'
DATA = 'data/' + FILE_PATTERN + '.parquet'
VIDEO = 'videos/{video_key}/' + FILE_PATTERN + '.mp4'
EPISODES = 'meta/episodes/' + FILE_PATTERN + '.parquet'
INFO, STATS, TASKS = 'meta/info.json', 'meta/stats.json', 'meta/tasks.parquet'

CAMERA = 'observation.images.camera'
STATE = 'observation.state'
OBJECTS = 'observation.environment_state'
ACTION = 'action'
ACTION_NAMES = ('dx', 'dy', 'dz', 'opening')
STATE_NAMES = GRIPPER_JOINTS
SEED, OUTCOME = 'tap_ros/seed', 'tap_ros/outcome'  # columns of ours beside LeRobot's


def place(number: int) -> dict[str, int]:
    """Return chunk_index and file_index of the file with this number, from 0."""
    return {'chunk_index': number // FILES_PER_CHUNK, 'file_index': number % FILES_PER_CHUNK}


def object_columns(names: tuple[str, ...]) -> list[str]:
    """Return the names of the numbers in OBJECTS: u and v of each object."""
    return [f'{name}_{axis}' for name in names for axis in 'uv']


def object_names(columns: list[Any]) -> tuple[str, ...] | None:
    """Return the objects that columns are of, None where they are not ours."""
    if len(columns) % 2 or not all(isinstance(column, str) for column in columns):
        return None
    names = tuple(column.removesuffix('_u') for column in columns[::2])
    return names if object_columns(names) == columns else None


def flat_names(feature: dict[str, Any]) -> list[Any]:
    """Return the names of a feature's numbers; some sets have them in a dict, or none."""
    names = feature.get('names')
    if isinstance(names, dict):
        names = [name for part in names.values() for name in _listed(part)]
    return names if isinstance(names, list) else []


def _listed(part: Any) -> Iterator[Any]:
    yield from part if isinstance(part, list) else [part]
