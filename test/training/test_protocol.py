# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictors by name: the baseline of recorded keyframes, and one of another package."""

from pathlib import Path

import cv2
from made_episodes import move_squares
import numpy as np
import pytest
from tap_ros import Predictor, SubgoalPredictor
from tap_ros.__main__ import main
from tap_ros.base import plugins
from tap_ros.base.errors import ConfigError, TapError, WeightsError
from tap_ros.images.crop import trained_crop
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.nearest_keyframe import halfway, NearestKeyframe, recorded_places
from tap_ros.prediction.protocol import load_predictor, predictor_files
from tap_ros.prediction.retrieval import ends_of, neighbours
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import write_marks
from tap_ros.weights import PREDICTORS

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'
STARTS = np.array([[[6.0, 8.0], [22.0, 20.0]], [[20.0, 6.0], [8.0, 24.0]]])
EPISODES = [move_squares(start, start + 5, length=9, seed=seed)
            for seed, start in enumerate(STARTS)]


def ask(predictor, episode, **others):
    return predictor.predict(episode.frames[0], episode.frames[-1], episode.object_pixels[0],
                             episode.object_pixels[-1], **others)


def test_a_task_that_was_recorded_once_is_answered_with_its_own_frame_half_way():
    for episode in EPISODES:
        predictor = NearestKeyframe([episode])
        subgoal, = ask(predictor, episode, num_samples=3)
        t = halfway(episode.frames, 8)
        assert 1 < t < 7 and (subgoal.image == episode.frames[t]).all()
        assert np.allclose(subgoal.expected_pixels, episode.object_pixels[t])
        assert np.allclose(subgoal.object_maps.sum((1, 2)), 1)
        assert subgoal.distance == 0 and not subgoal.warning
        earlier, later = ask(predictor, episode, recursion_depth=2)
        assert (later.image == subgoal.image).all() and (later.level, earlier.level) == (1, 2)
        assert (earlier.image == episode.frames[halfway(episode.frames, t)]).all()


@pytest.fixture(scope='module')
def sample():
    return open_recordings([SAMPLE], progress=False)


def test_the_median_of_the_marked_frames_of_the_five_most_alike_is_shown(sample):
    marks = {i: [(5 + i, 5 + i), (20, 22)] for i in range(0, 20, 2)}
    predictor, asked = NearestKeyframe(sample, marks), sample[1]
    ends = np.stack([ends_of(episode.frames[0], episode.frames[-1]) for episode in sample])
    alike = [i for i in neighbours(ends, 19)[0][1] if i in marks][:5]
    earlier, later = ask(predictor, asked, recursion_depth=2)
    for subgoal, frames in ((later, [21] * 5), (earlier, [5 + i for i in alike])):
        shown = [sample[i].frames[t] for i, t in zip(alike, frames)]
        assert (subgoal.image == np.median(shown, 0)).all()
        places = np.mean([recorded_places(sample[i], t, asked.object_pixels[0])
                          for i, t in zip(alike, frames)], 0)
        assert np.allclose(subgoal.expected_pixels, places, atol=1e-3)
        assert subgoal.distance == neighbours(ends, 19)[1][1][
            [i in marks for i in neighbours(ends, 19)[0][1]]][0]
    with pytest.raises(ConfigError, match='no recorded episode has two frames and marks'):
        NearestKeyframe(sample, {})


def test_what_is_unlike_all_recordings_is_said(sample):
    predictor = NearestKeyframe(sample)
    assert not ask(predictor, sample[3])[0].warning
    noise = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)
    subgoal, = predictor.predict(*noise)
    assert 'unlike every demonstration' in subgoal.warning and subgoal.distance > 30


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
    with pytest.raises(WeightsError, match="did you mean 'push2'.*valid: .*stack3"):
        SubgoalPredictor.load('pusch2')
    start, goal, out = (str(tmp_path / f'{name}.png') for name in ('start', 'goal', 'out'))
    for path, frame in ((start, 0), (goal, -1)):
        cv2.imwrite(path, EPISODES[0].frames[frame][..., ::-1])
    marks, store = tmp_path / 'labels.marks.json', open_recordings([bag], progress=False)
    write_marks(marks, store, [bag], {1: [(2, 2)]})
    for weights in ('copying:anything', f'nearest_keyframe:{bag}',
                    f'nearest_keyframe:{bag}:{marks}'):
        assert main(['predict', start, goal, '--weights', weights, '--out', out]) == 0
        assert 'subgoal' in capsys.readouterr().out
    assert (load_predictor(f'nearest_keyframe:{marks}:{bag}').predict(*EPISODES[0].frames[:2])[0]
            .image == store[1].frames[2]).all()
    assert load_predictor(f'nearest_keyframe:{bag}:size=32:crop=centre').image_size == (32, 32)
    for told in ('gap=x', 'gap=nan', 'image_topic=/none'):
        with pytest.raises(TapError, match='nearest_keyframe|gap|/none'):
            load_predictor(f'nearest_keyframe:{bag}:{told}')
    for argument in (str(marks), f'{bag}:{marks}:{marks}'):
        with pytest.raises(ConfigError, match='at most one file of marks'):
            load_predictor(f'nearest_keyframe:{argument}')
    cv2.imwrite(start, np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8))
    assert main(['predict', start, goal, '--weights', weights, '--out', out]) == 0
