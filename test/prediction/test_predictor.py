# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the predictor as the nodes use it."""

from dataclasses import replace

import numpy as np
import pytest
from tap_ros.errors import ConfigError, ImageError, WeightsError
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.weights import save_weights
import torch

CONFIG = PredictorConfig(image_size=32, base_width=4, new_pixels=False)
START, GOAL = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3), np.uint8)
START_PIXELS, GOAL_PIXELS = np.random.default_rng(1).uniform(4, 28, (2, 2, 2))


@pytest.fixture(scope='module')
def predictor():
    torch.manual_seed(0)
    return SubgoalPredictor(Predictor(CONFIG))


def test_answer_has_the_promised_types(predictor):
    subgoal, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    assert subgoal.image.shape == (32, 32, 3) and subgoal.image.dtype == np.uint8
    assert subgoal.object_maps.shape == (2, 32, 32) and subgoal.object_maps.dtype == np.float32
    assert np.allclose(subgoal.object_maps.sum((1, 2)), 1, atol=1e-5)
    assert (subgoal.object_maps >= 0).all()
    assert subgoal.expected_pixels.shape == (2, 2)
    v, u = np.indices((32, 32))
    assert np.allclose(subgoal.expected_pixels[:, 0], (subgoal.object_maps * u).sum((1, 2)),
                       atol=1e-3)
    assert np.allclose(subgoal.expected_pixels[:, 1], (subgoal.object_maps * v).sum((1, 2)),
                       atol=1e-3)


def test_equal_requests_get_equal_answers(predictor):
    first, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    second, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    assert np.array_equal(first.image, second.image)
    assert np.array_equal(first.object_maps, second.object_maps)


@pytest.mark.parametrize('pixels', [None, np.zeros((0, 2)), []])
def test_pictures_alone_will_do(predictor, pixels):
    subgoal, = predictor.predict(START, GOAL, pixels, pixels)
    assert subgoal.object_maps.shape == (0, 32, 32) and subgoal.expected_pixels.shape == (0, 2)
    assert np.array_equal(subgoal.image, predictor.predict(
        START, GOAL, START_PIXELS, GOAL_PIXELS)[0].image)


def test_order_of_objects_does_not_matter(predictor):
    subgoal, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    swapped, = predictor.predict(START, GOAL, START_PIXELS[::-1], GOAL_PIXELS[::-1])
    assert np.allclose(swapped.object_maps[::-1], subgoal.object_maps, atol=1e-6)


def test_recursion_ends_with_the_single_prediction(predictor):
    single, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    chain = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS, recursion_depth=3)
    assert len(chain) == 3
    assert np.array_equal(chain[-1].image, single.image)
    again, = predictor.predict(START, chain[-1].image, START_PIXELS, GOAL_PIXELS)
    difference = again.image.astype(int) - chain[-2].image
    assert np.abs(difference).max() <= 2  # pictures are rounded in between here
    for subgoal in chain:
        assert np.allclose(subgoal.object_maps.sum((1, 2)), 1, atol=1e-5)


def test_samples_differ_by_z_and_repeat_by_seed():
    torch.manual_seed(0)
    network = Predictor(replace(CONFIG, latent_size=8))
    predictor = SubgoalPredictor(network)
    first = predictor.predict(START, GOAL, num_samples=3, recursion_depth=2, seed=5)
    second = predictor.predict(START, GOAL, num_samples=3, recursion_depth=2, seed=5)
    assert len(first) == 6
    assert all(np.array_equal(a.image, b.image) for a, b in zip(first, second))
    assert not np.array_equal(first[1].image, first[3].image)


def test_without_z_all_samples_would_be_the_same(predictor):
    assert len(predictor.predict(START, GOAL, num_samples=5)) == 1


@pytest.mark.parametrize('start, goal, message', [
    (START[:16], GOAL, 'start: expected 32x32 pixels'),
    (START, GOAL.astype(np.float32), 'goal: expected a uint8'),
    (START, GOAL[..., 0], r'goal: expected shape'),
    (None, GOAL, 'start: expected a uint8')])
def test_unusable_pictures_are_named(predictor, start, goal, message):
    with pytest.raises(ImageError, match=message):
        predictor.predict(start, goal)


@pytest.mark.parametrize('start, goal, message', [
    ([[1, np.nan]], [[1, 2]], 'start_pixels: the position of object 0 is unknown'),
    ([[1, 2]], [[1, 2], [3, 4]], 'goal_pixels: expected 1 objects'),
    ([[1, 2]], None, 'goal_pixels: expected 1 objects'),
    ([1, 2], [[1, 2]], r'start_pixels: expected shape \(objects, 2\)')])
def test_unusable_positions_are_named(predictor, start, goal, message):
    with pytest.raises(ImageError, match=message):
        predictor.predict(START, GOAL, start, goal)


@pytest.mark.parametrize('name', ['num_samples', 'recursion_depth'])
def test_counts_below_one_are_refused(predictor, name):
    with pytest.raises(ConfigError, match=f'{name}: expected at least 1'):
        predictor.predict(START, GOAL, **{name: 0})


def test_next_good_request_works_after_a_bad_one(predictor):
    with pytest.raises(ImageError):
        predictor.predict(START[:5], GOAL)
    assert len(predictor.predict(START, GOAL)) == 1


def test_a_saved_predictor_answers_the_same(tmp_path):
    torch.manual_seed(1)
    network = Predictor(CONFIG)
    path = tmp_path / 'predictor.safetensors'
    save_weights(path, network, 'predictor', CONFIG, {'steps': 7})
    loaded = SubgoalPredictor.load(path)
    assert loaded.config == CONFIG and loaded.image_size == (32, 32)
    assert loaded.training == {'steps': 7}
    expected, = SubgoalPredictor(network).predict(START, GOAL)
    assert np.array_equal(loaded.predict(START, GOAL)[0].image, expected.image)


def test_weights_of_something_else_are_refused(tmp_path):
    path = tmp_path / 'weights.safetensors'
    save_weights(path, Predictor(CONFIG), 'forward_model', CONFIG, {})
    with pytest.raises(WeightsError, match='forward_model'):
        SubgoalPredictor.load(path)
    forward = replace(CONFIG, num_context=1)
    save_weights(path, Predictor(forward), 'predictor', forward, {})
    with pytest.raises(ConfigError, match='2 context pictures'):
        SubgoalPredictor.load(path)
