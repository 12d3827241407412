# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Subtasks written into a LeRobot data set, as its documentation describes them.

Each row of data/ gets a `subtask_index`; meta/subtasks.parquet names the subtasks, as the index of
a table, and meta/info.json the new feature.
"""

from collections.abc import Mapping, Sequence
import json
import os
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.files import open_alone, storage_errors
from tap_ros.base.text import escaped
from tap_ros.recording.formats.lerobot_format import (
    INDEX,
    INFO,
    MOST_BYTES,
    names_table,
    SUBTASK,
)
from tap_ros.recording.formats.pictures import DAMAGE
from tap_ros.recording.trust import inside, parse_json, read_bytes


class Ends(NamedTuple):
    """
    Where the subtasks of an episode end.

    :param ends: of each subtask but the last one, s from the start.
    :param length: s, of the episode, which tells whether it is that of the data set.
    """

    ends: Sequence[float]
    length: float


def segment_names(marks: Sequence[str]) -> list[str]:
    """Return the names of the parts into which marks cut a demonstration, one more than marks."""
    return [f'before {marks[0]}', *(f'{a} to {b}' for a, b in zip(marks, marks[1:])),
            f'after {marks[-1]}']


def write_subtasks(folder: str | Path, names: Sequence[str], episodes: Mapping[int, Ends]) -> int:
    """
    Write subtasks into a data set; those that it had are replaced.

    Files are written beside the old ones first and take their places together.

    :param folder: of the data set, with meta/info.json.
    :param names: of the subtasks, one more than the ends of an episode.
    :param episodes: all of the set, by their index.
    :return: the number of rows.
    :raises RecordingError: for a folder that holds no data set, or a damaged one; ConfigError for
        other episodes than its own; StorageError when it cannot be written. Then it is what it
        was.
    """
    import pyarrow
    from pyarrow import parquet
    root = Path(folder)
    try:
        info = parse_json(read_bytes(inside(root, INFO), MOST_BYTES))
        info['features'][SUBTASK], fps = INDEX, float(info['fps'])
        if not fps > 0:
            raise ValueError(f'{fps} frames a second')
    except (OSError, RecordingError, LookupError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{escaped(root)}: is no LeRobot data set: {escaped(error)}') from error
    done: dict[Path, Path] = {}
    rows, lengths = 0, dict[int, float]()

    def beside(path: Path) -> BinaryIO:
        part = path.with_name(f'{path.name}.part')
        stream = open_alone(part)
        done[path] = part
        return stream

    try:
        with storage_errors(root):
            with beside(root / 'meta/subtasks.parquet') as stream:
                parquet.write_table(names_table('subtask', {
                    name: k for k, name in enumerate(names)}), stream)
            for name in sorted(root.glob('data/*/*.parquet')):
                path = inside(root, name.relative_to(root))
                try:
                    with beside(path) as stream:
                        rows += _with_subtasks(path, stream, episodes, lengths)
                except (*DAMAGE, pyarrow.ArrowException) as error:
                    if isinstance(error, RecordingError) or getattr(error, 'errno', None):
                        raise  # which tells all, or is of storage
                    raise RecordingError(f'{escaped(path)}: {escaped(error, 200)}') from error
            if not lengths:
                raise RecordingError(f'{escaped(root)}: has no rows in data/*/*.parquet')
            other = [i for i in sorted({*lengths, *episodes}) if i not in lengths or abs(
                lengths[i] - episodes[i].length) > 1.5 / fps]
            if other:
                raise ConfigError(f'{escaped(root)}: episode {other[0]} is another one than in '
                                  'the recordings; name the set that they were imported from')
            with beside(root / INFO) as stream:
                stream.write(json.dumps(info, indent=4).encode() + b'\n')
            for path, part in done.items():
                os.replace(part, path)
    finally:
        for part in done.values():
            part.unlink(missing_ok=True)
    return rows


def _with_subtasks(path: Path, part: BinaryIO, given: Mapping[int, Ends],
                   lengths: dict[int, float]) -> int:
    """Copy a data file with its rows' subtasks, note its episodes; return the number of rows."""
    import pyarrow
    from pyarrow import parquet
    with parquet.ParquetFile(path) as file:
        schema = file.schema_arrow
        if SUBTASK in schema.names:
            schema = schema.remove(schema.get_field_index(SUBTASK))
        for name in ('episode_index', 'timestamp'):
            if name not in schema.names:
                raise RecordingError(f'{escaped(path)}: has no column {name}')
        schema = schema.append(pyarrow.field(SUBTASK, pyarrow.int64()))
        told = dict(schema.metadata or {})
        if b'huggingface' in told:  # the features, once more
            content = parse_json(told[b'huggingface'])
            content['info']['features'][SUBTASK] = {'dtype': 'int64', '_type': 'Value'}
            told[b'huggingface'] = json.dumps(content).encode()
        schema = schema.with_metadata(told or None)
        with parquet.ParquetWriter(part, schema) as writer:
            for batch in file.iter_batches():
                episodes = batch['episode_index'].to_numpy(zero_copy_only=False)
                times = batch['timestamp'].to_numpy(zero_copy_only=False)
                found = np.empty(len(times), np.int64)
                for episode in np.unique(episodes).tolist():
                    if episode not in given:
                        raise ConfigError(f'episode {episode} of the data set has no labels')
                    mine = episodes == episode
                    lengths[episode] = max(lengths.get(episode, 0.0), float(times[mine].max()))
                    # The row at a moment is the first of the next subtask, as in the MCAP file.
                    found[mine] = np.searchsorted(
                        given[episode].ends, times[mine] + 1e-4, side='right')
                columns = [batch[name] for name in schema.names if name != SUBTASK]
                writer.write_batch(pyarrow.RecordBatch.from_arrays(
                    [*columns, pyarrow.array(found)], schema=schema))
        return file.metadata.num_rows
