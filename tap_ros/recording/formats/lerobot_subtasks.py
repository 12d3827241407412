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

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.files import storage_errors, write_atomically
from tap_ros.base.text import escaped
from tap_ros.recording.trust import inside, parse_json, read_bytes

INFO, SUBTASKS, COLUMN = 'meta/info.json', 'meta/subtasks.parquet', 'subtask_index'
_MOST_BYTES = 2**26  # of JSON


def segment_names(marks: Sequence[str]) -> list[str]:
    """Return the names of the parts into which marks cut a demonstration, one more than marks."""
    return [f'before {marks[0]}', *(f'{a} to {b}' for a, b in zip(marks, marks[1:])),
            f'after {marks[-1]}']


def write_subtasks(folder: str | Path, names: Sequence[str],
                   ends: Mapping[int, Sequence[float]]) -> int:
    """
    Write subtasks into a data set; those that it had are replaced.

    Data files are written beside the old ones first and take their places together.

    :param folder: of the data set, with meta/info.json.
    :param names: of the subtasks, one more than the ends of an episode.
    :param ends: {episode index: where each subtask but the last one ends, s from its start}.
    :return: the number of rows.
    :raises RecordingError: for a folder that holds no data set, or a damaged one; ConfigError for
        episodes without an end; StorageError when it cannot be written. Then it is what it was.
    """
    import pyarrow
    from pyarrow import parquet
    root = Path(folder)
    try:
        info = parse_json(read_bytes(inside(root, INFO), _MOST_BYTES))
        info['features'][COLUMN] = {'dtype': 'int64', 'shape': [1], 'names': None}
    except (OSError, RecordingError, LookupError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{escaped(root)}: is no LeRobot data set: {escaped(error)}') from error
    done: dict[Path, Path] = {}
    rows = 0
    try:
        with storage_errors(root):
            for name in sorted(root.glob('data/*/*.parquet')):
                path = inside(root, name.relative_to(root))
                done[path] = path.with_name(f'{path.name}.part')
                rows += _with_subtasks(path, done[path], ends)
            if not done:
                raise RecordingError(f'{escaped(root)}: has no data/*/*.parquet')
            for path, part in done.items():
                os.replace(part, path)
    except pyarrow.ArrowException as error:
        raise RecordingError(f'{escaped(root)}: {escaped(error, 200)}') from error
    finally:
        for part in done.values():
            part.unlink(missing_ok=True)
    table = pyarrow.table({COLUMN: np.arange(len(names)), 'subtask': list(names)})
    # So pandas, and by it LeRobot, reads the names as the index.
    table = table.replace_schema_metadata({b'pandas': json.dumps({
        'index_columns': ['subtask'], 'column_indexes': [], 'columns': [
            {'name': name, 'field_name': name, 'pandas_type': kind, 'numpy_type': kind,
             'metadata': None} for name, kind in ((COLUMN, 'int64'), ('subtask', 'object'))],
        'pandas_version': '2.2.0'}).encode()})
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(table, sink)
    write_atomically(root / SUBTASKS, sink.getvalue().to_pybytes())
    write_atomically(root / INFO, json.dumps(info, indent=4) + '\n')
    return rows


def _with_subtasks(path: Path, part: Path, ends: Mapping[int, Sequence[float]]) -> int:
    """Copy a data file with its rows' subtasks; return the number of rows."""
    import pyarrow
    from pyarrow import parquet
    with parquet.ParquetFile(path) as file:
        schema = file.schema_arrow
        if COLUMN in schema.names:
            schema = schema.remove(schema.get_field_index(COLUMN))
        for name in ('episode_index', 'timestamp'):
            if name not in schema.names:
                raise RecordingError(f'{escaped(path)}: has no column {name}')
        schema = schema.append(pyarrow.field(COLUMN, pyarrow.int64()))
        told = dict(schema.metadata or {})
        if b'huggingface' in told:  # the features, once more
            content = parse_json(told[b'huggingface'])
            content['info']['features'][COLUMN] = {'dtype': 'int64', '_type': 'Value'}
            told[b'huggingface'] = json.dumps(content).encode()
        schema = schema.with_metadata(told or None)
        with parquet.ParquetWriter(part, schema) as writer:
            for batch in file.iter_batches():
                episodes = batch['episode_index'].to_numpy(zero_copy_only=False)
                times = batch['timestamp'].to_numpy(zero_copy_only=False)
                found = np.empty(len(times), np.int64)
                for episode in np.unique(episodes):
                    if int(episode) not in ends:
                        raise ConfigError(f'episode {episode} of the data set has no labels')
                    rows = episodes == episode
                    # A subtask ends with its last row.
                    found[rows] = np.searchsorted(ends[int(episode)], times[rows] - 1e-4)
                columns = [batch[name] for name in schema.names if name != COLUMN]
                writer.write_batch(pyarrow.RecordBatch.from_arrays(
                    [*columns, pyarrow.array(found)], schema=schema))
        return file.metadata.num_rows
