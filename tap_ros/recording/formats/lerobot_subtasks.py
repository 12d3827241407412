# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Subtasks written into a LeRobot data set, as its documentation describes them.

Each row of data/ gets a `subtask_index`; meta/subtasks.parquet names the subtasks, as the index of
a table, and meta/info.json the new feature. The package lerobot reads them from version 0.4.4 to
0.5, of sets of version 3.0; it takes the name by its place in the table, -1 for the last one.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import json
import os
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.files import open_alone, storage_errors
from tap_ros.base.text import escaped
from tap_ros.recording.formats.lerobot_format import (
    INDEX,
    INFO,
    listed,
    MOST_BYTES,
    names_table,
    read_parquet,
    SEED,
    SUBTASK,
)
from tap_ros.recording.formats.pictures import DAMAGE
from tap_ros.recording.trust import inside, parse_json, read_bytes

UNLABELLED = 'unlabelled'  # the last subtask, where some episodes have no labels


class Ends(NamedTuple):
    """
    Where the subtasks of an episode end.

    :param ends: of each subtask but the last one, s from the start, rising.
    :param length: s, of the episode, which tells whether it is that of the data set.
    :param step: s, the longest between two pictures: so much of the data set's rows may follow.
    """

    ends: Sequence[float]
    length: float
    step: float = 0.0


def segment_names(marks: Sequence[str]) -> list[str]:
    """Return the names of the parts into which marks cut a demonstration, one more than marks."""
    return [f'before {marks[0]}', *(f'{a} to {b}' for a, b in zip(marks, marks[1:])),
            f'after {marks[-1]}']


def describe_set(folder: str | Path) -> tuple[dict[str, Any], dict[int, int]]:
    """
    Return what meta/info.json says of a data set, and the index of each episode by its seed.

    The importer keeps the index of an episode as its seed, unless the set, one that was exported
    from recordings, has their seeds.

    :return: and {} where indices are the seeds.
    :raises RecordingError: for a folder that holds no data set, or a damaged one.
    """
    root, numbers = Path(folder), dict[int, int]()
    try:
        info = parse_json(read_bytes(inside(root, INFO), MOST_BYTES))
        info['features'][SUBTASK], fps = INDEX, float(info['fps'])
        if not fps > 0:
            raise ValueError(f'{fps} frames a second')
        for file in sorted(root.glob('meta/episodes/*/*.parquet')):
            table = read_parquet(root, file.relative_to(root))
            if {SEED, 'episode_index'} <= {*table.column_names}:
                numbers |= zip(listed(table[SEED]), listed(table['episode_index']))
    except (OSError, RecordingError, LookupError, TypeError, ValueError) as error:
        raise RecordingError(
            f'{escaped(root)}: is no LeRobot data set: {escaped(error)}') from error
    if not any(root.glob('data/*/*.parquet')):
        raise RecordingError(f'{escaped(root)}: has no rows in data/*/*.parquet')
    return info, numbers


def write_subtasks(folder: str | Path, names: Sequence[str],
                   episodes: Mapping[int, Ends]) -> tuple[int, int]:
    """
    Write subtasks into a data set; those that it had are replaced.

    All files are written beside the old ones first. Each then takes its place in one step; what is
    interrupted between two steps leaves old files and new ones, and running it again mends that.

    :param folder: of the data set, with meta/info.json.
    :param names: of the subtasks, one more than the ends of an episode.
    :param episodes: of the set, by their index; the rows of all others are UNLABELLED.
    :return: the number of rows, and of episodes without labels.
    :raises RecordingError: for a folder that holds no data set, or a damaged one; ConfigError for
        other episodes than its own, and ends that do not rise; StorageError when it cannot be
        written. Then it is what it was.
    """
    import pyarrow
    from pyarrow import parquet
    root, (info, _) = Path(folder), describe_set(folder)
    for i, one in episodes.items():
        if len(one.ends) != len(names) - 1 or not (np.diff([0, *one.ends]) > 0).all():
            raise ConfigError(f'episode {i}: expected {len(names) - 1} ends of subtasks, rising '
                              f'from 0 s, got {escaped(list(one.ends), 60)}')
    done: dict[Path, Path] = {}
    rows, lengths, slack = 0, dict[int, float](), 1.5 / float(info['fps'])

    @contextmanager
    def beside(path: Path) -> Iterator[BinaryIO]:
        part = path.with_name(f'{path.name}.part')
        with open_alone(part) as stream:
            done[path] = part
            yield stream
            stream.flush()
            os.fsync(stream.fileno())

    try:
        with storage_errors(root):
            for name in sorted(root.glob('data/*/*.parquet')):
                path = inside(root, name.relative_to(root))
                try:
                    with beside(path) as stream:
                        rows += _with_subtasks(path, stream, len(names), episodes, lengths)
                except (*DAMAGE, pyarrow.ArrowException) as error:
                    if isinstance(error, RecordingError) or getattr(error, 'errno', None):
                        raise  # which tells all, or is of storage
                    raise RecordingError(f'{escaped(path)}: {escaped(error, 200)}') from error
            for i, one in sorted(episodes.items()):
                if not -slack <= lengths.get(i, -np.inf) - one.length <= one.step + slack:
                    raise ConfigError(
                        f'{escaped(root)}: episode {i} is another one than in the recordings; '
                        'name the set that they were imported from')
            missing = len(lengths.keys() - episodes.keys())
            with beside(root / 'meta/subtasks.parquet') as stream:
                parquet.write_table(names_table('subtask', {name: k for k, name in enumerate(
                    [*names, UNLABELLED] if missing else names)}), stream)
            with beside(root / INFO) as stream:
                stream.write(json.dumps(info, indent=4).encode() + b'\n')
            for path, part in done.items():
                os.replace(part, path)
    finally:
        for part in done.values():
            part.unlink(missing_ok=True)
    return rows, missing


def _with_subtasks(path: Path, part: BinaryIO, unlabelled: int, given: Mapping[int, Ends],
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
                found = np.full(len(times), unlabelled)
                for episode in np.unique(episodes).tolist():
                    mine = episodes == episode
                    lengths[episode] = max(lengths.get(episode, 0.0), float(times[mine].max()))
                    if episode in given:
                        # The row at a moment is the first of the next subtask, as in the MCAP.
                        found[mine] = np.searchsorted(
                            given[episode].ends, times[mine] + 1e-4, side='right')
                columns = [batch[name] for name in schema.names if name != SUBTASK]
                writer.write_batch(pyarrow.RecordBatch.from_arrays(
                    [*columns, pyarrow.array(found)], schema=schema))
        return file.metadata.num_rows
