# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""LeRobot data sets: what is exported comes back, and what others wrote can be read."""

from itertools import islice
import json
import re
import shutil

import cv2
from made_episodes import write_bag
import numpy as np
import pandas
import pyarrow
from pyarrow import parquet
import pyarrow.compute
import pytest
from tap_ros.__main__ import main
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats import lerobot_export
from tap_ros.recording.formats.lerobot_format import ACTION, CAMERA, OBJECTS, STATE
from tap_ros.recording.marks import beside, read_marks, write_marks
from tap_ros.recording.reading import Reading


@pytest.fixture(scope='module')
def truth():
    return list(islice(open_recordings('bags/sample_push2'), 6))


def export(folder, episodes, *options):
    """Export in files of four episodes."""
    bag = write_bag(folder.with_name('bag'), episodes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_export, 'EPISODES_PER_FILE', 4)
        assert not main(['export-lerobot', '--recordings', str(bag), '--out', str(folder),
                         *options])
    return folder


@pytest.fixture(scope='module')
def exported(truth, tmp_path_factory):
    return export(tmp_path_factory.mktemp('sets') / 'png', truth)


def test_what_is_exported_comes_back(exported, truth, tmp_path, capsys):
    assert main(['import-lerobot', str(exported), '--out', str(tmp_path / 'bag')]) == 0
    assert f'6 episodes, {sum(map(len, truth))} frames' in capsys.readouterr().out
    found = list(open_recordings(tmp_path / 'bag'))
    assert len(found) == len(truth)
    for new, old in zip(found, truth):
        for name in ('frames', 'actions', 'grippers'):
            np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
        np.testing.assert_allclose(new.object_pixels, old.object_pixels)
        assert (new.object_names, new.task, new.seed, new.outcome) == (
            old.object_names, old.task, old.seed, old.outcome)
        np.testing.assert_array_equal(np.diff(new.stamps), np.diff(old.stamps))
        assert new.robot_masks is None and new.goal_frame is None


def test_with_a_mark_the_next_subtask_begins_and_marks_come_back(truth, tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', truth[:4])
    store, marks = open_recordings([bag], progress=False), {0: [(7, 7)], 2: [(3, 3), (9, 12)]}
    write_marks(beside(bag), store, [bag], marks)
    folder = export(tmp_path / 'set', truth[:4], '--marks', str(beside(bag)))
    info = json.loads((folder / 'meta' / 'info.json').read_text())
    assert info['features']['subtask_index'] == info['features']['task_index']
    table = pandas.read_parquet(folder / 'meta' / 'subtasks.parquet')
    assert table.index.name == 'subtask' and table['subtask_index'].tolist() == [0, 1, 2, 3]
    rows = parquet.read_table(folder / 'data/chunk-000/file-000.parquet').to_pandas()
    said = [list(dict.fromkeys(table.index[rows[rows.episode_index == i].subtask_index]))
            for i in range(4)]
    assert said == [['to mark 1', 'to the goal'], ['not marked'],
                    ['to mark 1', 'to mark 2', 'to the goal'], ['not marked']]
    assert np.flatnonzero(np.diff(rows[rows.episode_index == 2].subtask_index)).tolist() == [2, 9]
    assert main(['import-lerobot', str(folder), '--out', str(tmp_path / 'back')]) == 0
    assert 'marks where the next subtask begins, of 2 episodes' in capsys.readouterr().out
    store = open_recordings([tmp_path / 'back'], progress=False)
    assert read_marks(beside(tmp_path / 'back'), store).episodes == {
        0: [(7, 7)], 2: [(3, 3), (10, 10)]}


def test_of_another_robot_pictures_and_signals_are_taken_and_the_rest_is_named(
        exported, truth, tmp_path, capsys, recwarn):
    foreign = shutil.copytree(exported, tmp_path / 'foreign')
    path = foreign / 'meta' / 'info.json'
    info = json.loads(path.read_text())
    info['features'][ACTION] = {'dtype': 'float32', 'shape': [7], 'names': None}
    info['features'][STATE]['names'] = {'motors': ['a', 'b', 'c', 'd']}
    del info['features'][OBJECTS]
    info['features']['observation.images.wrist'] = info['features'][CAMERA]
    path.write_text(json.dumps(info))
    assert main(['import-lerobot', str(foreign), '--out', str(tmp_path / 'bag')]) == 1
    assert f'--camera: expected one of {CAMERA}, observation.images.wrist' in (
        capsys.readouterr().err)
    assert main(['import-lerobot', str(foreign), '--out', str(tmp_path / 'bag'),
                 '--camera', CAMERA]) == 0
    said = capsys.readouterr().out
    assert f'signals: {ACTION}, {STATE}: 11 numbers' in said
    assert 'not taken: observation.images.wrist' in said
    told = ' '.join(str(one.message) for one in recwarn)
    assert '6 signals: ' in told and f'{ACTION} of episode 0' in told  # their shape is wrong
    found = open_recordings(tmp_path / 'bag')
    assert not found.commands, 'nobody has sent commands of ours'
    for new, old in zip(found, truth, strict=True):
        np.testing.assert_array_equal(new.frames, old.frames)
        assert not new.actions.any() and np.isnan(new.grippers).all() and not new.object_names
        assert new.signal_names == tuple(f'{STATE}/{name}' for name in 'abcd')
        np.testing.assert_array_equal(new.signals, old.grippers)


def spoil(folder, number=3):
    """Spoil a picture of the first file."""
    file = folder / 'data/chunk-000/file-000.parquet'
    table = parquet.read_table(file)
    cells = table[CAMERA].to_pylist()
    cells[number]['bytes'] = b'no picture'
    parquet.write_table(table.set_column(
        table.column_names.index(CAMERA), CAMERA,
        pyarrow.array(cells, table.schema.field(CAMERA).type)), file)


@pytest.mark.parametrize('path, change, words, left', [
    ('meta/info.json', lambda file: file.unlink(),
     'set: is no LeRobot data set: .*info.json is not there', 0),
    ('meta/info.json', lambda file: file.write_text(file.read_text().replace('v3.0', 'v1.6')),
     'v1.6, .* expected v2 or v3', 0),
    ('meta/info.json', lambda file: file.write_text(file.read_text().replace('feat', 'other')),
     "garbles 'features'", 0),
    ('meta/episodes/chunk-000/file-000.parquet', lambda file: file.unlink(), 'no episode', 0),
    ('data/chunk-000/file-000.parquet', lambda file: file.unlink(),
     '4 episodes: .*file-000.parquet is not there.* 2 and 1 more', 2),
    ('data/chunk-000/file-001.parquet', lambda file: file.write_bytes(file.read_bytes()[:5000]),
     '2 episodes: .*file-001.parquet: cannot be read', 4),
    ('', spoil, 'picture 3 of episode 0: no picture, or a damaged one', 6)])
def test_what_is_damaged_is_counted_and_the_rest_imported(
        path, change, words, left, exported, truth, tmp_path, capsys, recwarn):
    folder = shutil.copytree(exported, tmp_path / 'set')
    change(folder / path)
    code = main(['import-lerobot', str(folder), '--out', str(tmp_path / 'bag')])
    said = capsys.readouterr().err + ''.join(str(each.message) for each in recwarn)
    assert code == (not left) and re.search(words, said), said
    found = list(open_recordings(tmp_path / 'bag')) if left else []
    assert len(found) == left and bool(left) == (tmp_path / 'bag').exists()
    for new in found:
        old, = (old for old in truth if old.seed == new.seed)
        rows = [t for t in range(len(old)) if new.seed != truth[0].seed or path or t != 3]
        np.testing.assert_array_equal(new.frames, old.frames[rows])
        np.testing.assert_array_equal(new.object_pixels, old.object_pixels[rows])


def rewrite(folder, path, change):
    """Change a table of a set."""
    file = folder / path / 'chunk-000' / 'file-000.parquet'
    parquet.write_table(change(parquet.read_table(file)), file)


def test_version_2_comes_as_version_3_does(exported, truth, tmp_path):
    """Version 2 has a file an episode, lines of JSON instead of tables, and other paths."""
    folder = tmp_path / 'set'
    shutil.copytree(exported, folder)
    tables = [parquet.read_table(path) for path in sorted(folder.glob('data/*/*.parquet'))]
    for path in folder.glob('data/*/*'):
        path.unlink()
    rows = [(e, part) for table in tables for e in dict.fromkeys(
        table['episode_index'].to_pylist()) for part in [table.filter(
            pyarrow.compute.equal(table['episode_index'], e))]]
    for e, part in rows:
        parquet.write_table(part, folder / f'data/chunk-000/episode_{e:06d}.parquet')
    shutil.rmtree(folder / 'meta' / 'episodes')
    (folder / 'meta' / 'episodes.jsonl').write_text(''.join(json.dumps(
        {'episode_index': e, 'tasks': ['push'], 'length': len(part)}) + '\n' for e, part in rows))
    info = json.loads((folder / 'meta' / 'info.json').read_text())
    info |= {'codebase_version': 'v2.1', 'data_path':
             'data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet'}
    info['features'][CAMERA]['shape'] = [3, 64, 64]  # channels first, as some sets have it
    (folder / 'meta' / 'info.json').write_text(json.dumps(info))
    assert main(['import-lerobot', str(folder), '--out', str(tmp_path / 'bag')]) == 0
    for new, old in zip(open_recordings(tmp_path / 'bag'), truth, strict=True):
        np.testing.assert_array_equal(new.frames, old.frames)
        np.testing.assert_allclose(new.object_pixels, old.object_pixels)
        assert new.task == 'push'


@pytest.fixture
def filmed(tmp_path):
    """
    Return a set of two episodes of 8 rows at 4 Hz that was filmed at 12 Hz.

    The grey of a picture tells the number of its row, counted through both episodes.
    """
    folder, key, N = tmp_path / 'filmed', 'observation.images.top', 16
    for name in ('data', 'meta/episodes', f'videos/{key}'):
        (folder / name / 'chunk-000').mkdir(parents=True)
    place = 'chunk-{chunk_index:03d}/file-{file_index:03d}'
    (folder / 'meta' / 'info.json').write_text(json.dumps({
        'codebase_version': 'v3.0', 'fps': 4, 'data_path': f'data/{place}.parquet',
        'video_path': f'videos/{{video_key}}/{place}.mp4',
        'features': {key: {'dtype': 'video', 'shape': [64, 64, 3]}}}))
    index = np.arange(N)
    parquet.write_table(pyarrow.table({
        'timestamp': (index % 8 / 4).astype(np.float32), 'index': index,
        'episode_index': index // 8}), folder / 'data/chunk-000/file-000.parquet')
    parquet.write_table(pyarrow.Table.from_pylist([{
        'episode_index': e, 'length': 8, 'tasks': ['push'], 'dataset_from_index': 8 * e,
        **{f'{part}/{name}_index': 0 for part in ('data', f'videos/{key}')
           for name in ('chunk', 'file')}, f'videos/{key}/from_timestamp': 2.0 * e}
        for e in range(2)]), folder / 'meta/episodes/chunk-000/file-000.parquet')
    video = cv2.VideoWriter(str(folder / f'videos/{key}/chunk-000/file-000.mp4'),
                            cv2.VideoWriter.fourcc(*'mp4v'), 12, (64, 64))
    for i in range(3 * N):
        video.write(np.full((64, 64, 3), i // 3 * 15, np.uint8))
    video.release()
    return folder, key


@pytest.mark.parametrize('second', [2.0, 1.5, 0.0])
def test_frames_are_those_of_the_rows_times_and_of_one_episode_each(
        filmed, tmp_path, second, recwarn):
    folder, key = filmed
    name = f'videos/{key}/from_timestamp'
    rewrite(folder, 'meta/episodes', lambda table: table.set_column(
        table.column_names.index(name), name, pyarrow.array([0.0, second])))
    assert main(['import-lerobot', str(folder), '--out', str(tmp_path / 'bag')]) == 0
    seen = np.concatenate([e.frames.mean((1, 2, 3)) for e in open_recordings(tmp_path / 'bag')])
    assert np.abs(seen - 15 * np.arange(16)).max() < 5
    assert any('within the one before' in str(each.message) for each in recwarn) == (second < 2)


def test_each_camera_of_version_3_has_videos_of_its_own(filmed, tmp_path):
    folder, key = filmed
    other = key.replace('top', 'side')
    path, videos = folder / 'meta/info.json', folder / 'videos'
    info = json.loads(path.read_text())
    info['features'][other] = info['features'][key]
    path.write_text(json.dumps(info))
    shutil.copytree(videos / key, videos / other)
    shutil.copy(videos / key / 'chunk-000/file-000.mp4', videos / other / 'chunk-000/file-001.mp4')

    def add(table):
        for name, values in (('chunk_index', [0, 0]), ('file_index', [1, 0]),
                             ('from_timestamp', [2.0, 0.0])):
            table = table.append_column(f'videos/{other}/{name}', pyarrow.array(values))
        return table
    rewrite(folder, 'meta/episodes', add)
    assert main(['import-lerobot', str(folder), '--out', str(tmp_path / 'bag'), '--camera', key,
                 '--camera', other]) == 0
    for topic, rows in (('', np.arange(16)), ('/camera/side/image_raw', np.arange(16) ^ 8)):
        seen = np.concatenate([e.frames.mean((1, 2, 3)) for e in open_recordings(
            tmp_path / 'bag', reading=Reading(topic))])
        assert np.abs(seen - 15 * rows).max() < 5
