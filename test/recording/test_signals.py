# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numbers by name that a robot measured or was told, beside what we know of it."""

import dataclasses

from made_bags import camera, joints, read, record
from made_episodes import assert_all_equal, make_episode, write_bag
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.base.contract import MOST_SIGNALS
from tap_ros.base.errors import RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats.lerobot_format import signal_names
from test_importers import bair, make_frames, rlds, run_import
from test_importers import record as tfrecord


def with_signals(seed, names, **changes):
    episode = make_episode(seed, **changes)
    values = np.random.default_rng(seed).normal(size=(len(episode), len(names)))
    return dataclasses.replace(episode, signal_names=tuple(names),
                               signals=values.astype(np.float32))


def test_signals_come_back_also_of_episodes_that_have_others_or_none(tmp_path, capsys):
    size = (64, 64)
    episodes = [with_signals(0, ['hand/thumb', 'hand/ring'], start=10**10, size=size),
                make_episode(1, start=2 * 10**11, size=size),
                with_signals(2, ['force'], start=4 * 10**11, size=size),
                with_signals(3, ['hand/ring', 'hand/thumb', 'x'], start=6 * 10**11, size=size)]
    bag = write_bag(tmp_path / 'bag', episodes[:3], episodes[3:])
    for _ in range(2):  # decoded, and from the cache
        found = list(open_recordings(bag))
        assert_all_equal(found, episodes)
        for new, old in zip(found, episodes, strict=True):
            assert new.signal_names == old.signal_names
            assert (new.signals is None) == (old.signals is None)
            if old.signals is not None:
                np.testing.assert_array_equal(new.signals, old.signals)
    main(['inspect', str(bag)])
    assert 'signals     force, hand/ring, hand/thumb, x' in capsys.readouterr().out


def test_a_signal_is_the_nearest_and_unknown_far_away(tmp_path):
    messages = [camera(t) for t in range(1, 7)] + [
        joints(t, topic='/robot/signals', force=10.0 * t) for t in (1.1, 1.9, 3.0, 5.9)]
    bad = [joints(4, topic='/robot/signals', **{f'n{k}': 0.0 for k in range(MOST_SIGNALS + 1)})]
    (episode,), told = read(record(tmp_path / 'bag', sorted(
        messages + bad, key=lambda one: one[3])))
    assert episode.signal_names == ('force',)
    np.testing.assert_allclose(episode.signals[:, 0], [11, 19, 30, np.nan, np.nan, 59])
    assert any(f'{MOST_SIGNALS + 1} numbers with' in line for line in told)


def test_signals_without_names_are_refused(tmp_path):
    episode = with_signals(0, ['a', 'b'])
    for wrong in ({'signal_names': ('a',)}, {'signal_names': ()}, {'signals': None},
                  {'signals': episode.signals.astype(float)}):
        with pytest.raises(RecordingError, match=r'Episode\.signals: expected'):
            write_bag(tmp_path / 'bag', [dataclasses.replace(episode, **wrong)])


def test_the_numbers_of_features_get_names_within_bounds():
    features = {
        'state': {'dtype': 'float32', 'shape': [2], 'names': [['x', 'y']]},
        'done': {'dtype': 'bool', 'shape': [1], 'names': None},
        'action': {'dtype': 'float64', 'shape': [3], 'names': {'motors': ['a', 'b', 'c']}},
        'twice': {'dtype': 'int64', 'shape': [2], 'names': ['a', 'a']},
        'other': {'dtype': 'int8', 'shape': [2], 'names': ['a']},
        'grid': {'dtype': 'float32', 'shape': [2, 2]}, 'text': {'dtype': 'string', 'shape': [1]},
        'vast': {'dtype': 'float32', 'shape': [10**15]}, 'none': {'dtype': 'uint8', 'shape': [0]},
        'odd': {'dtype': 'float32', 'shape': 'x'}}
    assert signal_names(features, features) == {
        'action': ['action/a', 'action/b', 'action/c'], 'done': ['done'],
        'other': ['other/0', 'other/1'], 'state': ['state/x', 'state/y']}
    wide = {f'f{k}': {'dtype': 'float32', 'shape': [100]} for k in range(4)}
    assert list(signal_names(wide, wide)) == ['f0', 'f1']


def test_floats_of_records_are_signals(tmp_path, capsys):
    frames, state = make_frames(0, 6, 16), np.arange(12.0).tolist()
    with open(tmp_path / 'a.tfrecord', 'wb') as file:
        file.write(tfrecord(rlds(frames) | {'steps/observation/state': state,
                                            'steps/odd': [1.0] * 7}))
    for options, rows in ((), slice(None)), (('--rate', 2.5), slice(None, None, 2)):
        bag = tmp_path / f'bag{len(options)}'
        code, said = run_import(
            capsys, 'import-tfrecord', tmp_path, '--camera', 'image_0', '--out', bag, *options)
        assert code == 0 and 'signals: observation/state: 2 numbers\n' in said
        episode, = open_recordings(bag)
        assert episode.signal_names == ('observation/state/0', 'observation/state/1')
        np.testing.assert_array_equal(episode.signals, np.reshape(state, (6, 2))[rows])
    (tmp_path / 'a.tfrecord').write_bytes(tfrecord(bair(frames)))
    assert not run_import(capsys, 'import-tfrecord', tmp_path, '--out', tmp_path / 'c')[0]
    episode, = open_recordings(tmp_path / 'c')
    assert episode.signal_names == tuple(f'action/{k}' for k in range(4))
    np.testing.assert_array_equal(episode.signals, np.arange(4) + np.zeros((6, 1)))


def test_numbers_beside_arrays_of_pictures_are_signals(tmp_path, capsys):
    h5py = pytest.importorskip('h5py')
    pictures, angles = make_frames(0, 6, 16), np.random.default_rng(0).normal(size=(6, 3))
    with h5py.File(tmp_path / 'in.h5', 'w') as file:
        for number in range(2):
            demo = file.create_group(f'data/demo_{number}')
            demo['obs/camera'], demo['obs/joints'] = pictures, angles + number
            demo['actions'], demo['few'], demo['text'] = np.arange(6), angles[:4], np.array(
                [b'a'] * 6)
        file['data/all'] = angles  # of no demonstration
        layout = h5py.VirtualLayout((6, 2), 'f8')
        file.create_virtual_dataset('data/demo_0/elsewhere', layout)
    code, said = run_import(capsys, 'import-arrays', tmp_path / 'in.h5', '--fps', 4, '--rate', 2,
                            '--out', tmp_path / 'bag')
    assert code == 0 and 'signals: actions, obs/joints: 4 numbers\n' in said
    for number, episode in enumerate(open_recordings(tmp_path / 'bag')):
        assert episode.signal_names == ('actions', *(f'obs/joints/{k}' for k in range(3)))
        np.testing.assert_allclose(episode.signals, np.concatenate(
            [np.arange(6)[:, None], angles + number], 1)[::2], rtol=1e-6)
