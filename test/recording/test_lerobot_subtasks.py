# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subtasks in a LeRobot data set: all else stays, and they come back as marks."""

import json

from made_episodes import write_bag
import numpy as np
import pandas
import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats.lerobot_subtasks import Ends, segment_names, write_subtasks
from tap_ros.recording.marks import beside, read_marks

NAMES = ('grasp', 'release')
EPISODES = list(open_recordings('bags/sample_push2'))[:3]


def ended(*ends):
    return {i: Ends(ends, float(np.ptp(one.stamps)) / 1e9) for i, one in enumerate(EPISODES)}


@pytest.fixture
def exported(tmp_path):
    bag = write_bag(tmp_path / 'bag', EPISODES)
    assert not main(['export-lerobot', '--recordings', str(bag), '--out', str(tmp_path / 'set')])
    return tmp_path / 'set'


def test_subtasks_come_back_as_marks_and_all_else_stays(exported, tmp_path):
    data = next((exported / 'data').glob('*/*.parquet'))
    before = pandas.read_parquet(data)
    for ends in ([0.5, 1.25], [0.75, 1.5]):  # again: those that there were are replaced
        rows = write_subtasks(exported, segment_names(NAMES), ended(*ends))
    after = pandas.read_parquet(data)
    assert rows == len(before) and after.drop(columns='subtask_index').equals(before)
    table = pandas.read_parquet(exported / 'meta' / 'subtasks.parquet')
    assert table.index.name == 'subtask' and table['subtask_index'].tolist() == [0, 1, 2]
    assert list(table.index) == ['before grasp', 'grasp to release', 'after release']
    info = json.loads((exported / 'meta' / 'info.json').read_text())
    assert info['features']['subtask_index']['dtype'] == 'int64'
    assert main(['import-lerobot', str(exported), '--out', str(tmp_path / 'back')]) == 0
    store = open_recordings([tmp_path / 'back'], progress=False)
    assert read_marks(beside(tmp_path / 'back'), store).episodes == {
        i: [(3, 3), (6, 6)] for i in range(3)}
    assert not list(exported.rglob('*.part'))


def test_what_cannot_be_written_whole_is_not_written(exported, tmp_path):
    before = {path: path.read_bytes() for path in exported.rglob('*') if path.is_file()}
    with pytest.raises(ConfigError, match='episode 2 of the data set has no labels'):
        write_subtasks(exported, segment_names(NAMES), dict([*ended(0.5, 1).items()][:2]))
    one = ended(0.5, 1)
    for other in (one | {1: Ends([0.5, 1], one[1].length + 1)}, one | {3: one[2]}):
        with pytest.raises(ConfigError, match='episode [13] is another one than in the'):
            write_subtasks(exported, segment_names(NAMES), other)
    with pytest.raises(RecordingError, match='is no LeRobot data set'):
        write_subtasks(tmp_path, segment_names(NAMES), {})
    assert {path: path.read_bytes() for path in exported.rglob('*') if path.is_file()} == before
