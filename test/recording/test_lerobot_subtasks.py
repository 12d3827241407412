# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subtasks in a LeRobot data set: all else stays, and they come back as marks."""

import json

from made_episodes import write_bag
from made_lerobot import write_set
import numpy as np
import pandas
import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats.lerobot_subtasks import (
    describe_set,
    Ends,
    segment_names,
    write_subtasks,
)
from tap_ros.recording.marks import beside, read_marks, write_marks

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
        rows, missing = write_subtasks(exported, segment_names(NAMES), ended(*ends))
    after = pandas.read_parquet(data)
    assert after.drop(columns='subtask_index').equals(before)
    assert (rows, missing) == (len(before), 0)
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
    for ends in ([np.nan, 1], [5, 2], [1, 1], [0, 1], [1], [1, 2, 3]):
        with pytest.raises(ConfigError, match='episode 0: expected 2 ends of subtasks, rising'):
            write_subtasks(exported, segment_names(NAMES), ended(*ends))
    one = ended(0.5, 1)
    for other in (one | {1: Ends([0.5, 1], one[1].length + 1)}, one | {3: one[2]}):
        with pytest.raises(ConfigError, match='episode [13] is another one than in the'):
            write_subtasks(exported, segment_names(NAMES), other)
    with pytest.raises(RecordingError, match='is no LeRobot data set'):
        write_subtasks(tmp_path, segment_names(NAMES), {})
    assert {path: path.read_bytes() for path in exported.rglob('*') if path.is_file()} == before


def test_rows_of_episodes_without_labels_say_so(exported):
    some = {i: one for i, one in ended(0.5, 1.25).items() if i != 1}
    assert write_subtasks(exported, segment_names(NAMES), some)[1] == 1
    names = pandas.read_parquet(exported / 'meta' / 'subtasks.parquet')
    rows = pandas.read_parquet(next((exported / 'data').glob('*/*.parquet')))
    said = names.index[rows['subtask_index']]  # by place, as lerobot does
    assert {*said[rows['episode_index'] == 1]} == {'unlabelled'}
    assert [*dict.fromkeys(said[rows['episode_index'] == 2])] == segment_names(NAMES)


def test_what_was_interrupted_is_mended_by_running_it_again(exported, monkeypatch):
    write_subtasks(exported, segment_names(NAMES), ended(0.5, 1.25))
    whole = {path: path.read_bytes() for path in exported.rglob('*') if path.is_file()}
    write_subtasks(exported, segment_names('abc'), ended(0.5, 0.75, 1.25))

    def replace(source, target):
        if str(target).endswith('subtasks.parquet'):
            raise KeyboardInterrupt
        source.rename(target)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr('os.replace', replace)
        write_subtasks(exported, segment_names(NAMES), ended(0.5, 1.25))
    write_subtasks(exported, segment_names(NAMES), ended(0.5, 1.25))
    assert {path: path.read_bytes() for path in exported.rglob('*') if path.is_file()} == whole


def test_demonstrations_are_known_by_their_index_also_at_a_rate_and_when_one_is_lost(
        tmp_path, capsys):
    """Of the second one no picture can be used, and every third row is taken."""
    pictures = np.random.default_rng(0).integers(0, 256, (4, 36, 16, 16, 3), np.uint8)
    lengths = (36, 30, 34, 31)
    folder, bag, out = write_set(tmp_path / 'set', [{'front': one[:length] if k != 1 else [
        b'no picture'] * length} for k, (one, length) in enumerate(zip(pictures, lengths))]), str(
            tmp_path / 'bag'), str(tmp_path / 'out')
    assert main(['import-lerobot', str(folder), '--out', bag, '--rate', '3']) == 0
    store = open_recordings([bag], progress=False)
    assert len(store) == 3 and store.lengths[0] in (11, 12)
    write_marks(beside(bag), store, [bag], {0: [(3, 3)], 1: [(4, 4)]}, ['grasp'])
    moments = [0, 2], [store.seconds(0)[3], store.seconds(1)[4]]
    capsys.readouterr()
    assert main(['label', bag, '--out', out, '--write-lerobot', str(folder)]) == 0
    said = capsys.readouterr().out
    assert '1 demonstration without labels: unlabelled' in said
    assert 'is of v2.1, and lerobot shows the subtasks of v3.0 only' in said
    for episode, moment in zip(*moments):
        rows = pandas.read_parquet(folder / f'data/chunk-000/episode_{episode:06d}.parquet')
        assert (rows['subtask_index'] == (rows['timestamp'] >= moment - 1e-3)).all()
    lost = pandas.read_parquet(folder / 'data/chunk-000/episode_000001.parquet')
    assert {*lost['subtask_index']} == {2}


def test_a_folder_that_is_no_set_is_refused_before_anything_is_labelled(tmp_path, capsys):
    bag, out = write_bag(tmp_path / 'bag', EPISODES), tmp_path / 'out'
    for folder, said in ((tmp_path, 'is no LeRobot data set'), (tmp_path / 'no', 'is no LeRobot')):
        assert main(['label', str(bag), '--out', str(out), '--write-lerobot', str(folder)]) == 1
        assert said in capsys.readouterr().err and not out.exists()


def test_episodes_of_an_exported_set_are_known_by_the_seeds_of_the_recordings(exported):
    assert describe_set(exported)[1] == {one.seed: i for i, one in enumerate(EPISODES)}
