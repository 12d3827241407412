# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of trainings with keyframes: labelled frames of the most alike demonstrations."""

from dataclasses import replace

from lively import lively_network
from made_episodes import cover, write_bag
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.images.pixels import to_float
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.protocol import Request
from tap_ros.prediction.retrieval import ends_of, learned_weights, neighbours
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.training.batches import Pictures
from tap_ros.training.frames import FilledStore
from tap_ros.training.keyframes import Keyframes, NEIGHBOURS, NUM_KEYFRAMES
from tap_ros.training.marks import episode_preferences
from tap_ros.training.objective import Networks, predictor_loss
from tap_ros.training.predictor import draw_batch, train
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights.weights import load_weights


@pytest.fixture
def store(bag):
    return open_recordings([bag], progress=False)


@pytest.fixture
def config(bag, store, tmp_path):
    write_marks(tmp_path / 'marks.json', store, [bag], {
        i: [(n // 2, n // 2)] for i, n in enumerate(store.lengths[:10].tolist())})
    return TrainingConfig(
        recordings=(str(bag),), out=str(tmp_path / 'run'), base_width=4, batch_size=4, steps=4,
        margin=1, start_crop=0.0, test_fraction=0.3, threads=1, save_every=2, precision='float32',
        selection='marks', marks=str(tmp_path / 'marks.json'), keyframes=True)


def test_what_is_drawn_is_the_label_of_another_demonstration_that_is_alike(store, config):
    episodes = np.arange(2, len(store))
    labels = [int(n) // 2 for n in store.lengths]
    preference = [np.eye(int(n), dtype=np.float32)[[t]] for n, t in zip(store.lengths, labels)]
    keyframes, rng = Keyframes(store, episodes, preference, config), np.random.default_rng(0)
    ends = np.stack([ends_of(*store.frames(int(i))[[0, -1]]) for i in episodes])
    near = neighbours(ends, NEIGHBOURS, learned_weights(ends, np.stack([
        store.frames(int(i))[labels[i]] for i in episodes])))[0]
    shown = {i: {store.frames(int(episodes[j]))[labels[episodes[j]]].tobytes() for j in near[n]}
             for n, i in enumerate(episodes)}
    drawn = {i: set() for i in episodes}
    for _ in range(30):
        for i, pictures in zip(episodes, keyframes.draw(episodes, rng)[:, 0].numpy()):
            assert len({picture.tobytes() for picture in pictures}) == NUM_KEYFRAMES
            drawn[i] |= {picture.tobytes() for picture in pictures}
    assert all(drawn[i] <= shown[i] for i in episodes)
    assert np.mean([len(drawn[i]) / len(shown[i]) for i in episodes]) > 0.9


def test_a_demonstration_whose_label_shows_something_else_is_left_out(
        store, config, tmp_path, capsys):
    frames = store.frames(7).copy()
    frames[1] = 255 - frames[1]
    bag = write_bag(tmp_path / 'odd', [
        replace(one, frames=frames) if i == 7 else one for i, one in enumerate(store)])
    odd, everything = open_recordings([bag], progress=False), np.arange(len(store))
    labels = [1 if i == 7 else int(n) // 2 for i, n in enumerate(odd.lengths)]
    preference = [np.eye(int(n), dtype=np.float32)[[t]] for n, t in zip(odd.lengths, labels)]
    keyframes = Keyframes(odd, everything, preference, config)
    assert 7 in keyframes.left_out and len(keyframes.left_out) < 5
    drawn = keyframes.draw(everything, np.random.default_rng(0)).flatten(0, 2).numpy()
    assert all((picture != frames[1]).any() for picture in drawn)
    assert len(keyframes.bank()) == len(store) - len(keyframes.left_out)
    write_marks(config.marks, odd, [bag], {i: [(t, t)] for i, t in enumerate(labels[:8])})
    train(replace(config, recordings=(str(bag),), test_fraction=0.0, steps=1), progress=False)
    assert 'the labelled frames of 7 differ' in capsys.readouterr().err


def test_no_demonstration_is_shown_its_own_label(store, config, tmp_path):
    """Nor where others begin and end exactly alike."""
    same = [replace(one, frames=np.concatenate([
        store.frames(0)[:1], one.frames[1:-1], store.frames(0)[-1:]])) for one in store]
    bag = write_bag(tmp_path / 'same', same)
    alike, everything = open_recordings([bag], progress=False), np.arange(len(store))
    labels = [int(n) // 2 for n in alike.lengths]
    preference = [np.eye(int(n), dtype=np.float32)[[t]] for n, t in zip(alike.lengths, labels)]
    keyframes, rng = Keyframes(alike, everything, preference, config), np.random.default_rng(0)
    for _ in range(10):
        for i, shown in enumerate(keyframes.draw(everything, rng)[:, 0].numpy()):
            assert all((picture != alike.frames(i)[labels[i]]).any() for picture in shown)


@pytest.mark.parametrize('count', [1, 2, 3])
def test_few_demonstrations_show_as_many_keyframes(store, config, count):
    episodes = np.arange(count)
    preference = [np.eye(int(n), dtype=np.float32)[[2]] for n in store.lengths]
    keyframes = Keyframes(store, episodes, preference, config)
    drawn = keyframes.draw(episodes, np.random.default_rng(0))
    assert drawn.shape[:3] == (count, 1, NUM_KEYFRAMES) and len(keyframes.bank()) == count


def test_weights_hold_the_keyframes_of_the_training_and_answer_with_them(store, config):
    train(config, stop_at=2, progress=False)
    weights = train(config, progress=False)
    whole = train(replace(config, out=f'{config.out}2'), progress=False)
    for name, tensor in load_weights(whole, 'predictor')[1].items():
        assert (tensor == load_weights(weights, 'predictor')[1][name]).all(), name
    network, training = load_network(weights)
    assert network.config.num_keyframes == NUM_KEYFRAMES and isinstance(network.bank, KeyframeBank)
    assert len(network.bank) == training['episodes'] == 24 - training['held_out']
    frames = store.frames(20)
    subgoal, = SubgoalPredictor(network, training).predict_together([Request(
        start=frames[0], goal=frames[-1], start_pixels=np.zeros((0, 2), np.float32),
        goal_pixels=np.zeros((0, 2), np.float32))])[0]
    assert subgoal.image.shape == frames[0].shape and subgoal.distance > 0


def test_each_of_two_marks_has_its_keyframe_as_targets_show_it(store, config, tmp_path):
    """With recursion, and where the robot is taken out of the pictures."""
    bag = write_bag(tmp_path / 'covered', [cover(one, side=6, seed=0) for one in store])
    store, config = open_recordings([bag], progress=False), replace(
        config, recordings=(str(bag),), steps=2)
    write_marks(config.marks, store, [bag], {
        i: [(n // 3, n // 3), (2 * n // 3, 2 * n // 3)]
        for i, n in enumerate(store.lengths[:10].tolist())})
    config = replace(config, recursion=2, robot_mask='all', fill_context=1.0)
    weights, everything = train(config, progress=False), np.arange(len(store))
    preference, _ = episode_preferences(store, config, everything)
    filled = FilledStore(store, 'all')
    keyframes = Keyframes(store, everything, preference, config, filled)
    bank = keyframes.bank()
    assert bank.levels == 2 and len(bank) == len(store)
    for i in range(10):
        n = store.lengths[i]
        for level, t in enumerate((2 * n // 3, n // 3), 1):
            shown = bank.keyframes[bank.numbers(np.array([i]), level)[0]]
            assert (shown == filled.frames(i)[t]).all()
    assert any((filled.frames(i) != store.frames(i)).any() for i in range(10))
    tensors = bank.tensors()
    assert tensors['bank.objects'].shape == (len(store), 3, 2, 2)
    np.testing.assert_array_equal(
        tensors['bank.objects'][4, 1], store[4].object_pixels[2 * store.lengths[4] // 3])
    assert (tensors['bank.ends'][4].numpy() == ends_of(*filled.frames(4)[[0, -1]])).all()
    network, training = load_network(weights)
    frames, pixels = store.frames(20), store[20].object_pixels
    found = SubgoalPredictor(network, training).predict(
        frames[0], frames[-1], pixels[0], pixels[-1], recursion_depth=2)
    assert [subgoal.level for subgoal in found] == [2, 1]


def test_each_level_is_trained_with_its_own_keyframe(store, config):
    write_marks(config.marks, store, config.recordings, {
        i: [(n // 3, n // 3), (2 * n // 3, 2 * n // 3)]
        for i, n in enumerate(store.lengths[:10].tolist())})
    config, everything = replace(config, recursion=2), np.arange(len(store))
    preference, _ = episode_preferences(store, config, everything)
    keyframes = Keyframes(store, everything, preference, config)
    batch = draw_batch(store, everything, config, Pictures(
        preference=preference, keyframes=keyframes), 0)
    assert batch.context.shape[1] == 2 and batch.keyframes.shape[1] == 2
    assert (batch.keyframes[:, 0] != batch.keyframes[:, 1]).any()
    shown, network = [], lively_network(
        num_context=2 + NUM_KEYFRAMES, image_size=store.image_size[0])
    network.register_forward_pre_hook(lambda _, given: shown.append(given[0]))
    predictor_loss(Networks(network), batch, config)
    assert len(shown) == 2
    for level, given in enumerate(shown):
        assert given[:, 2:].equal(batch.augmentation.apply(to_float(batch.keyframes[:, level])))
    assert shown[0][:, 0].equal(shown[1][:, 0]) and not shown[0][:, 1].equal(shown[1][:, 1])


@pytest.mark.parametrize('values', [
    {'new_pixels': True}, {'recursion': 9}, {'mode': 'forward'},
    {'selection': 'relative', 'marks': ''}])
def test_keyframes_go_with_marks_and_copying_alone(config, values):
    with pytest.raises(ConfigError, match='^keyframes'):
        replace(config, **values).check()
