# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of marks: their file, and what is learned from them and trained with it."""

from collections import Counter
from dataclasses import replace
import hashlib
import json

from made_episodes import make_episode, move_squares, write_bag
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError
from tap_ros.recording import known
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks, write_marks
from tap_ros.recording.mcap_file import McapFile
from tap_ros.training.marks import episode_preferences, LEAST, LIKELIEST
from tap_ros.training.predictor import train
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights.weights import load_weights


@pytest.fixture
def store(bag):
    return open_recordings([bag], progress=False)


@pytest.fixture
def marks(bag, store, tmp_path):
    """Mark the middle of the first ten demonstrations."""
    path = tmp_path / 'marks.json'
    write_marks(path, store, [bag], {i: [(n // 2, n // 2)] for i, n in enumerate(
        store.lengths[:10].tolist())})
    return path


def test_marks_are_read_as_they_were_written_by_hand_too(bag, store, tmp_path):
    episodes = {0: [(2, 2), (4, 4)], 3: [(1, 5)], 20: [(3, 3)]}
    path = tmp_path / 'deep' / 'marks.json'
    write_marks(path, store, [bag], episodes)
    found = read_marks(path, store)
    assert found.episodes == episodes and len(found.digest) == 64
    first = int(store[3].stamps[0])
    for seconds in (first / 1e9 + 0.5, first / 1e9 + 0.6):  # frames are 0.25 s apart
        path.write_text(json.dumps({'marks': [
            {'recording': str(bag), 'episode': 3, 'stamps': [seconds]}]}))
        assert read_marks(path, store).episodes == {3: [(2, 2)]}
    beside = bag / 'bottlenecks.json'
    beside.write_text(json.dumps({'marks': [
        {'recording': '.', 'episode': 3, 'stamps': [[first / 1e9, first / 1e9 + 0.5]]}]}))
    assert read_marks(beside, store).episodes == {3: [(1, 2)]}
    beside.unlink()


def test_marks_of_something_else_are_refused_with_the_file_and_the_reason(bag, store, tmp_path):
    other = write_bag(tmp_path / 'other', [make_episode(1)])
    begin, end = (int(store[0].stamps[k]) / 1e9 for k in (0, -1))
    path = tmp_path / 'marks.json'

    def refusal(data):
        path.write_text(data if isinstance(data, str) else json.dumps({'marks': [
            {'recording': str(bag), 'episode': 0, 'stamps': [begin + 0.5], **data}]}))
        with pytest.raises(ConfigError) as error:
            read_marks(path, store)
        text = str(error.value)
        assert text.startswith(str(path)) and text.isprintable()
        return text

    for data, said in (
            ({'recording': str(other)}, 'none of those that are read'),
            ({'episode': 24}, 'expected 0 to 23'), ({'stamps': [begin - 1]}, 'outside'),
            ({'stamps': [end + 1]}, 'outside'), ({'stamps': [begin]}, 'start or the goal'),
            ({'stamps': [begin + 1, begin + 0.5]}, 'in order'), ({'stamps': 3}, 'list of seconds'),
            ({'stamps': [float('nan')]}, 'as seconds'), ('{', 'no file of marks'),
            ({'episode': True}, 'no file of marks')):
        assert said in refusal(data), data
    entry = {'recording': str(bag), 'episode': 0, 'stamps': [begin + 0.5]}
    for names in ('grasp', ['grasp', 'grasp'], ['']):
        assert '"names" are not usable' in refusal(json.dumps({'names': names, 'marks': [entry]}))
    assert 'marked above' in refusal(json.dumps({'marks': [entry, entry]}))


def test_a_training_learns_from_marks_and_tells_of_them(bag, store, marks, tmp_path, capsys):
    config = TrainingConfig(
        recordings=(str(bag),), out=str(tmp_path / 'run'), base_width=4, batch_size=4, steps=4,
        margin=1, start_crop=0.0, test_fraction=0.3, threads=1, save_every=2, precision='float32',
        selection='marks', marks=str(marks))
    about = load_weights(train(config, stop_at=2, progress=False), 'predictor')[2]
    told = capsys.readouterr().err
    assert 'demonstrations. Learned from the others, a mark is found within 0.2' in told
    found = about['marks']
    assert found['sha256'] == read_marks(marks, store).digest
    levels, = found['levels']
    assert levels['demonstrations'] == 10 and levels['found'] >= 4 and 0 < levels['random'] < 0.8
    assert about['settings']['marks'] == str(marks)
    train(config, progress=False)
    marks.write_text(marks.read_text().replace('"episode": 2', '"episode":  2'))
    with pytest.raises(ConfigError, match='other recordings or marks'):
        train(config, progress=False)
    for values, said in (({'recursion': 2}, 'has 1, and each needs 2'),
                         ({'held_out': (str(bag),)}, 'too short|held out')):
        with pytest.raises(Exception, match=said):
            train(replace(config, out=str(tmp_path / 'other'), **values), progress=False)
    for values in ({'marks': ''}, {'loss': 'min'}, {'selection': 'relative'},
                   {'start_crop': 0.3}, {'min_crop': 0.5}):
        with pytest.raises(ConfigError, match='^marks'):
            replace(config, **values).check()
    with pytest.raises(ConfigError, match='mark some of those that are not held out'):
        episode_preferences(store, config, np.array([23]))


def test_the_likeliest_frames_are_those_about_the_label(bag, store, marks, tmp_path):
    config = TrainingConfig(recordings=(str(bag),), selection='marks', start_crop=0.0,
                            marks=str(marks))
    everything = np.arange(len(store))
    found, about = episode_preferences(store, config, everything)
    for i, w in enumerate(found):
        assert w.shape == (1, store.lengths[i]) and w.dtype == np.float32 and w.max() == 1
        assert (w > LEAST).sum() <= LIKELIEST and np.isfinite(np.log(w)).all()
        if i < 10:
            assert w[0].argmax() == store.lengths[i] // 2, 'what was marked is not guessed'
    assert np.mean([abs(w[0].argmax() - n // 2) <= 1
                    for w, n in zip(found[10:], store.lengths[10:])]) > 0.7
    # What was labelled by the others would be found by them: that says nothing.
    write_marks(marks, store, [bag], read_marks(marks, store).episodes, labels={7, 8, 9})
    told = episode_preferences(store, config, everything)[1]['marks']['levels']
    assert told == [{'demonstrations': 10, 'labels': 3}]
    # Of two marks the later one comes first between start and goal, the earlier one forward.
    write_marks(marks, store, [bag], {i: [(1, 1), (3, 3)] for i in range(10)})
    two = replace(config, recursion=2)
    back, ahead = (episode_preferences(store, one, everything)[0] for one in (
        two, replace(two, mode='forward')))
    for one, other in zip(back, ahead):
        np.testing.assert_array_equal(one, other[::-1])
    assert back[0].argmax(1).tolist() == [3, 1]
    # By its name one of them is trained on alone; labels are those of both together.
    write_marks(marks, store, [bag], read_marks(marks, store).episodes, ('grasp', 'release'))
    for name, row in (('grasp', 1), ('release', 0)):
        alone, told = episode_preferences(store, replace(config, mark_name=name), everything)
        assert len(told['marks']['levels']) == 1
        for one, other in zip(alone, back):
            np.testing.assert_array_equal(one, other[row:row + 1])
    for values, said in (({'mark_name': 'lift'}, 'lift is none of the marks; .* grasp, release'),
                         ({}, 'has 2, .* or choose one of grasp, release by --mark-name')):
        with pytest.raises(ConfigError, match=said):
            episode_preferences(store, replace(config, **values), everything)
    with_one_less = {**read_marks(marks, store).episodes, 4: [(2, 2)]}
    write_marks(marks, store, [bag], with_one_less, ('grasp', 'release'))
    with pytest.raises(ConfigError, match='demonstration 4 has 1, not as many as the names grasp'):
        episode_preferences(store, replace(config, mark_name='grasp'), everything)
    for values in ({'recursion': 2}, {'marks': '', 'selection': 'relative'}):
        with pytest.raises(ConfigError, match='^mark_name'):
            replace(config, mark_name='grasp', **values).check()


@pytest.mark.slow
def test_a_training_opens_and_hashes_each_file_once(tmp_path, monkeypatch):
    # The labels need the whole pictures, the training their middle, the keyframes full ones.
    rng = np.random.default_rng(0)
    whole = [move_squares(rng.uniform(20, 40, (2, 2)), rng.uniform(40, 60, (2, 2)), 9, 96, 8, i)
             for i in range(27)]
    bag = write_bag(tmp_path / 'wide', (
        replace(one, frames=np.ascontiguousarray(one.frames[:, :72]), goal_frame=None, task='')
        for one in whole))
    path = tmp_path / 'wide.marks.json'
    write_marks(path, open_recordings([bag], tmp_path / 'other', progress=False), [bag], {
        i: [(4, 4)] for i in range(10)})
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path / 'cache'))
    monkeypatch.setattr(known, '_SETTLED_NS', 0)  # files made just now count as old ones
    done = Counter()

    def counted(what, function):
        def call(*args):
            done[what, str(getattr(args[0], 'name', args[-1]))] += 1
            return function(*args)
        return call
    monkeypatch.setattr(McapFile, '__init__', counted('opened', McapFile.__init__))
    monkeypatch.setattr(hashlib, 'file_digest', counted('hashed', hashlib.file_digest))
    assert main(['train', 'predictor', str(bag), '--marks', str(path), '--crop', 'centre',
                 '--size', '32', '--keyframes', '--no-new-pixels', '--steps', '2',
                 '--threads', '1', '--out', str(tmp_path / 'run')]) == 0
    assert done == {(what, str(file)): 1 for what in ('opened', 'hashed')
                    for file in bag.glob('*.mcap')}
