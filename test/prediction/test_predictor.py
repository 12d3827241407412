# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the predictor as the nodes use it."""

from dataclasses import replace

from lively import lively_network
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError, ImageError, WeightsError
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.protocol import Request
from tap_ros.prediction.warp import one_hot_maps, warp_object_maps
from tap_ros.weights.weights import save_weights
import torch

CONFIG = PredictorConfig(image_size=32, base_width=4, new_pixels=False)
START, GOAL = np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3), np.uint8)
START_PIXELS, GOAL_PIXELS = np.random.default_rng(1).uniform(4, 28, (2, 2, 2))


@pytest.fixture(scope='module')
def predictor():
    return SubgoalPredictor(lively_network())


def differ(a, b):
    """Return the mean absolute difference of two pictures, from 0 to 255."""
    return np.abs(a.astype(int) - b).mean()


def test_equal_requests_get_equal_answers_and_pictures_alone_will_do(predictor):
    first, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    second, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    assert np.array_equal(first.image, second.image)
    assert np.array_equal(first.object_maps, second.object_maps)
    assert np.allclose(first.object_maps.sum((1, 2)), 1, atol=1e-5)
    assert (first.object_maps >= 0).all()
    alone, = predictor.predict(START, GOAL)
    assert alone.object_maps.shape == (0, 32, 32) and alone.expected_pixels.shape == (0, 2)
    assert np.array_equal(alone.image, first.image)


def test_recursion_ends_with_the_single_prediction(predictor):
    single, = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS)
    chain = predictor.predict(START, GOAL, START_PIXELS, GOAL_PIXELS, recursion_depth=3)
    assert len(chain) == 3
    assert np.array_equal(chain[-1].image, single.image)
    assert [subgoal.level for subgoal in chain] == [3, 2, 1]
    again, = predictor.predict(START, chain[-1].image, START_PIXELS, GOAL_PIXELS)
    assert differ(again.image, chain[-2].image) < 1  # pictures are rounded in between here
    assert differ(single.image, chain[-2].image) > 10
    for subgoal in chain:
        assert np.allclose(subgoal.object_maps.sum((1, 2)), 1, atol=1e-5)


def test_going_forward_each_prediction_is_the_next_context():
    network = lively_network(num_context=1)
    chain = SubgoalPredictor(network).predict(START, start_pixels=START_PIXELS, recursion_depth=3)
    assert [subgoal.level for subgoal in chain] == [1, 2, 3]
    context = to_float(START[None, None])
    maps = one_hot_maps(torch.from_numpy(START_PIXELS)[None, None], (32, 32))
    for subgoal in chain:
        with torch.no_grad():
            prediction = network(context)  # x <- G(x)
        maps = warp_object_maps(maps, prediction.flow, prediction.masks).maps[:, None]
        context = prediction.image[:, None]
        assert differ(subgoal.image, to_uint8(prediction.image)[0]) < 0.1
        assert np.allclose(subgoal.object_maps, maps[0, 0].numpy(), atol=1e-4)
    assert differ(chain[0].image, chain[1].image) > 10
    assert np.abs(chain[2].expected_pixels - chain[0].expected_pixels).max() > 0.2


@pytest.mark.parametrize('num_context, latent_size', [(1, 0), (2, 8)])
def test_requests_answered_together_are_answered_as_alone(num_context, latent_size):
    predictor = SubgoalPredictor(lively_network(num_context=num_context, latent_size=latent_size))
    rng = np.random.default_rng(2)
    asked = []
    for K, samples, depth in ((2, 1, 1), (2, 3, 2), (0, 2, 1), (2, 1, 3), (1, 1, 1), (2, 2, 1)):
        start, goal = rng.integers(0, 256, (2, 32, 32, 3), np.uint8)
        start_pixels, goal_pixels = rng.uniform(4, 28, (2, K, 2))
        if num_context == 1:
            goal = goal_pixels = None
        asked.append(Request(start, goal, start_pixels, goal_pixels, samples, depth, len(asked)))
    for request, together in zip(asked, predictor.predict_together(asked), strict=True):
        alone = predictor.predict(
            request.start, request.goal, request.start_pixels, request.goal_pixels,
            request.num_samples, request.recursion_depth, request.seed)
        if latent_size and request.num_samples > 1 and request.recursion_depth == 1:
            assert differ(alone[0].image, alone[-1].image) > 5  # by z
        for one, other in zip(alone, together, strict=True):
            assert (one.sample, one.level) == (other.sample, other.level)
            assert differ(one.image, other.image) < 0.1
            assert np.allclose(one.object_maps, other.object_maps, atol=1e-4)


def test_what_cannot_be_used_is_named_and_the_next_request_is_answered(predictor):
    for start, goal, message in (
            (START[:16], GOAL, 'start: expected 32x32 pixels'),
            (START, GOAL.astype(np.float32), 'goal: expected a uint8')):
        with pytest.raises(ImageError, match=message):
            predictor.predict(start, goal)
    for start, goal, message in (
            ([[1, np.nan]], [[1, 2]], r'start_pixels: unknown .* objects \[0\]'),
            ([[1, 2]], None, 'goal_pixels: expected 1 objects'),
            ([1, 2], [[1, 2]], r'start_pixels: expected shape \(objects, 2\)')):
        with pytest.raises(ImageError, match=message):
            predictor.predict(START, GOAL, start, goal)
    with pytest.raises(ConfigError, match='num_samples: expected at least 1'):
        predictor.predict(START, GOAL, num_samples=0)
    assert len(predictor.predict(START, GOAL)) == 1


def test_saved_weights_answer_the_same_and_those_that_predict_nonsense_are_refused(tmp_path):
    path, network = tmp_path / 'predictor.safetensors', PredictorNetwork(CONFIG)
    save_weights(path, network, 'predictor', CONFIG, {'steps': 7})
    loaded = SubgoalPredictor.load(path)
    assert loaded.training == {'steps': 7}
    expected, = SubgoalPredictor(network).predict(START, GOAL)
    assert np.array_equal(loaded.predict(START, GOAL)[0].image, expected.image)
    for weight in network.parameters():
        weight.data.fill_(3e38)  # finite, unlike what comes of it
    save_weights(path, network, 'predictor', CONFIG, {})
    with pytest.raises(WeightsError, match='predictor.safetensors: .* damaged'):
        SubgoalPredictor.load(path)
    video = replace(CONFIG, num_context=4)
    save_weights(path, PredictorNetwork(video), 'predictor', video, {})
    with pytest.raises(WeightsError, match='4 pictures without a bank'):
        SubgoalPredictor.load(path)
