# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of trainings with a third picture: labelled frames of the most alike demonstrations."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.protocol import Request
from tap_ros.prediction.retrieval import ends_of, neighbours
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.training.keyframes import Keyframes, NEIGHBOURS
from tap_ros.training.predictor import train
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


def test_what_is_drawn_is_the_label_of_another_demonstration_that_is_alike(store):
    episodes = np.arange(2, len(store))
    labels = [int(n) // 2 for n in store.lengths]
    preference = [np.eye(int(n), dtype=np.float32)[[t]] for n, t in zip(store.lengths, labels)]
    keyframes, rng = Keyframes(store, episodes, preference), np.random.default_rng(0)
    near = neighbours(np.stack([
        ends_of(*store.frames(int(i))[[0, -1]]) for i in episodes]), NEIGHBOURS)[0]
    shown = {i: {store.frames(int(episodes[j]))[labels[episodes[j]]].tobytes() for j in near[n]}
             for n, i in enumerate(episodes)}
    drawn = {i: set() for i in episodes}
    for _ in range(30):
        for i, picture in zip(episodes, keyframes.draw(episodes, rng)[:, 0].numpy()):
            drawn[i].add(picture.tobytes())
    assert all(drawn[i] <= shown[i] for i in episodes)
    assert np.mean([len(drawn[i]) / len(shown[i]) for i in episodes]) > 0.9


def test_weights_hold_the_keyframes_of_the_training_and_answer_with_them(store, config):
    train(config, stop_at=2, progress=False)
    weights = train(config, progress=False)
    whole = train(replace(config, out=f'{config.out}2'), progress=False)
    for name, tensor in load_weights(whole, 'predictor')[1].items():
        assert (tensor == load_weights(weights, 'predictor')[1][name]).all(), name
    network, training = load_network(weights)
    assert network.config.num_context == 3 and isinstance(network.bank, KeyframeBank)
    assert len(network.bank) == training['episodes'] == 24 - training['held_out']
    frames = store.frames(20)
    subgoal, = SubgoalPredictor(network, training).predict_together([Request(
        start=frames[0], goal=frames[-1], start_pixels=np.zeros((0, 2), np.float32),
        goal_pixels=np.zeros((0, 2), np.float32))])[0]
    assert subgoal.image.shape == frames[0].shape and subgoal.distance > 0


@pytest.mark.parametrize('values', [
    {'new_pixels': True}, {'recursion': 2}, {'mode': 'forward'},
    {'selection': 'relative', 'marks': ''}])
def test_keyframes_go_with_marks_and_copying_alone(config, values):
    with pytest.raises(ConfigError, match='^keyframes'):
        replace(config, **values).check()
