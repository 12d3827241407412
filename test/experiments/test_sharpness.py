# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How sharp subgoals are: what they are compared with."""

from experiments import fullsize
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from tap_ros.base.errors import ConfigError
from tap_ros.images.pixels import resize_image
from tap_ros.prediction.predictor import load_network, SubgoalPredictor

SEED = fullsize.FIRST_SCENE


@pytest.fixture(scope='module')
def camera():
    camera = Simulator('push2')
    yield camera
    camera.close()


def test_either_object_may_be_the_one_that_is_moved_and_the_other_stays(camera):
    case, = fullsize.cases(camera, range(SEED, SEED + 1), False)
    assert len(case.truths) == 2
    for k, places in enumerate(case.places):
        assert np.abs(places[k] - case.goal_pixels[k]).max() < 0.5
        assert np.abs(places[1 - k] - case.start_pixels[1 - k]).max() < 0.5


def test_errors_are_those_of_the_pictures_that_are_shown(camera):
    case, = fullsize.cases(camera, range(SEED, SEED + 1), False)
    network, training = load_network('push2')
    score, (start, goal, enlarged, full, truth) = fullsize.compare(
        network, SubgoalPredictor(network, training), case)
    for name, picture in (('enlarged', enlarged), ('full', full)):
        assert score[name] == pytest.approx(np.abs(picture.astype(int) - truth).mean(), abs=1e-3)
    assert 0.01 > score['full'] < score['copied'] < score['enlarged']
    assert score['objects_px'] < 0.1 and score['objects_full_px'] < 0.1
    assert np.abs(resize_image(full, (64, 64)).astype(int) - resize_image(
        enlarged, (64, 64))).mean() < 2, 'the same picture'


def test_weights_of_ones_own_are_scored_in_the_rows_of_their_task_alone():
    assert list(fullsize.scored(())) == list(fullsize.ROWS)
    assert fullsize.scored(('order2=a/b=c.safetensors',)) == {
        'order2': 'a/b=c.safetensors', 'order2 demonstrated': 'a/b=c.safetensors'}
    for wrong in ('grasps=x', 'grasp', 'grasp=', 'order2 demonstrated=x'):
        with pytest.raises(ConfigError, match='grasp=FILE'):
            fullsize.scored((wrong,))
