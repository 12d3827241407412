# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictors by name: the baseline of recorded keyframes, and one of another package."""

import cv2
from made_episodes import move_squares
import numpy as np
import pytest
from tap_ros import Predictor
from tap_ros.apps.cli import main
from tap_ros.base import plugins
from tap_ros.base.errors import ConfigError, WeightsError
from tap_ros.images.crop import trained_crop
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.nearest_keyframe import halfway, NearestKeyframe
from tap_ros.prediction.protocol import load_predictor, predictor_files
from tap_ros.weights import PREDICTORS

STARTS = np.array([[[6.0, 8.0], [22.0, 20.0]], [[20.0, 6.0], [8.0, 24.0]]])
EPISODES = [move_squares(start, start + 5, length=9, seed=seed)
            for seed, start in enumerate(STARTS)]


def ask(predictor, episode, **others):
    return predictor.predict(episode.frames[0], episode.frames[-1], episode.object_pixels[0],
                             episode.object_pixels[-1], **others)


def test_a_recorded_task_is_answered_with_its_own_frame_half_way():
    predictor = NearestKeyframe(EPISODES)
    for episode in EPISODES:
        subgoal, = ask(predictor, episode, num_samples=3)
        t = halfway(episode.frames, 8)
        assert 1 < t < 7 and (subgoal.image == episode.frames[t]).all()
        assert np.allclose(subgoal.expected_pixels, episode.object_pixels[t])
        assert np.allclose(subgoal.object_maps.sum((1, 2)), 1)
        earlier, later = ask(predictor, episode, recursion_depth=2)
        assert (later.image == subgoal.image).all() and (later.level, earlier.level) == (1, 2)
        assert (earlier.image == episode.frames[halfway(episode.frames, t)]).all()


class Copying(Predictor):
    """Shows the goal; of the package of somebody else."""

    mode, image_size, training = 'bidirectional', (32, 32), {}
    camera_crop = trained_crop(training, image_size)

    @classmethod
    def load(cls, argument, device):
        assert argument == 'anything'
        return cls()

    def predict_together(self, requests):
        return [[Subgoal(request.goal, np.zeros((0, 32, 32), np.float32),
                         np.zeros((0, 2), np.float32), np.zeros(0, np.float32), 0, 1)]
                for request in requests]


def test_predictors_go_by_name_also_those_of_other_packages(bag, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(plugins.BUILT_IN['tap_ros.predictors'], 'copying', f'{__name__}:Copying')
    assert isinstance(load_predictor('copying:anything'), Copying)
    assert predictor_files('copying:anything') == []
    assert predictor_files('push2') == [PREDICTORS['push2']]
    for name, error, said in (('nearest_keyframe', ConfigError, 'nearest_keyframe:bags'),
                              ('pusch2', WeightsError, "did you mean 'push2'"),
                              ('nowhere/push2.safetensors', WeightsError, 'no such weights')):
        with pytest.raises(error, match=said):
            load_predictor(name)
    start, goal, out = (str(tmp_path / f'{name}.png') for name in ('start', 'goal', 'out'))
    for path, frame in ((start, 0), (goal, -1)):
        cv2.imwrite(path, EPISODES[0].frames[frame][..., ::-1])
    for weights in ('copying:anything', f'nearest_keyframe:{bag}'):
        assert main(['predict', start, goal, '--weights', weights, '--out', out]) == 0
        assert 'subgoal' in capsys.readouterr().out
