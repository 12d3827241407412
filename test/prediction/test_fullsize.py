# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictions at the size of the pictures that are sent."""

import cv2
from lively import lively_network
import numpy as np
import pytest
from sim_bridge.simulator import Simulator
from tap_ros.base.errors import ImageError
from tap_ros.images.pixels import resize_image, resize_pixels, to_float, to_uint8
from tap_ros.prediction.fullsize import enlarged, STEEPER
from tap_ros.prediction.networks import Prediction
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.prediction.protocol import Request
from tap_ros.prediction.warp import combine, warp
import torch
from torch.nn import functional

SMALL = (32, 32)


def smooth(size, count, seed=0):
    """Return pictures, uint8 (count, *size, 3), without edges."""
    coarse = np.random.default_rng(seed).integers(0, 256, (count, 9, 9, 3), np.uint8)
    return np.stack([cv2.resize(one, size[::-1], interpolation=cv2.INTER_CUBIC) for one in coarse])


def made(contexts, new=True, seed=0):
    """Return a Prediction that moves, blends and paints."""
    generator = torch.Generator().manual_seed(seed)

    def values(*shape):
        coarse = torch.randn(*shape, 5, 5, generator=generator)
        return functional.interpolate(coarse, SMALL, mode='bilinear')

    flow = 3 * values(contexts, 2)[None]
    masks = torch.softmax(3 * values(contexts + new, 1), 0)[None]
    return Prediction(torch.zeros(1, 3, *SMALL), flow, masks,
                      torch.tanh(values(1, 3)) if new else None)


@pytest.mark.parametrize('contexts, new, size', [
    (1, False, (96, 96)), (2, True, (96, 96)), (3, True, (96, 128)), (3, False, (77, 77))])
def test_flow_and_masks_read_the_full_pictures_as_they_do_the_small_ones(contexts, new, size):
    made_here, sources = made(contexts, new), smooth(size, contexts)

    def wide(values, mode='bilinear'):
        return functional.interpolate(values, size, mode=mode, align_corners=False)

    scale = torch.tensor([size[1] / SMALL[1], size[0] / SMALL[0]])[:, None, None]
    expected = combine(
        warp(to_float(sources)[None], wide(made_here.flow[0])[None] * scale),
        torch.softmax(STEEPER * wide(made_here.masks[0].log()), 0)[None],
        wide(made_here.new_pixels, 'bicubic') if new else None)
    found, = enlarged(made_here, [list(sources)], [size])
    assert found.shape == (*size, 3) and found.dtype == np.uint8
    assert np.abs(found.astype(int) - to_uint8(expected)[0]).max() <= 4  # of remap's 1/32 px
    halves = [sources[0], *(resize_image(one, (size[0] // 2, size[1] // 2))
                            for one in sources[1:])]
    mixed, = enlarged(made_here, [halves], [size])
    assert np.abs(mixed.astype(int) - found).mean() < 2  # a source may be coarser


def test_an_answer_is_nearer_to_the_true_picture_than_a_small_one_enlarged():
    predictor, camera = SubgoalPredictor.load('push2'), Simulator('push2')
    try:
        for seed in range(1_950_002, 1_950_005):
            start, goal = camera.reset(seed), camera.goal()
            full, = predictor.predict(
                start.image, goal.image, start.object_pixels, goal.object_pixels)
            small, = predictor.predict(*(
                resize_image(seen.image, (64, 64)) for seen in (start, goal)), *(
                resize_pixels(seen.object_pixels, (256, 256), (64, 64)) for seen in (start, goal)))
            assert np.array_equal(full.object_maps, small.object_maps)
            assert np.allclose(full.expected_pixels, resize_pixels(
                small.expected_pixels, (64, 64), (256, 256)))
            enlargement = cv2.resize(small.image, (256, 256), interpolation=cv2.INTER_CUBIC)
            truths = []
            for k in range(2):  # either object may be the one that is moved first
                poses = np.array(start.object_poses)
                poses[k] = goal.object_poses[k]
                truths.append(camera.photograph(poses, start.gripper, True).image.astype(int))
            coarse, sharp = (min(np.abs(picture - truth).mean() for truth in truths)
                             for picture in (enlargement, full.image))
            assert sharp < 0.2 < 2 < coarse
    finally:
        camera.close()


def test_every_sample_and_level_is_of_the_full_size():
    predictor = SubgoalPredictor(lively_network(latent_size=8))
    start, goal = smooth((96, 96), 2)
    pixels = np.array([[[20.5, 31], [70, 64]], [[33, 60], [80, 12]]], np.float32)
    found = predictor.predict(start, goal, *pixels, num_samples=3, recursion_depth=2, seed=4)
    small = predictor.predict(
        *(resize_image(one, SMALL) for one in (start, goal)),
        *(resize_pixels(each, (96, 96), SMALL) for each in pixels), 3, 2, 4)
    for one, coarse in zip(found, small, strict=True):
        assert one.image.shape == (96, 96, 3) and coarse.image.shape == (*SMALL, 3)
        assert np.array_equal(one.object_maps, coarse.object_maps)
        assert np.abs(resize_image(one.image, SMALL).astype(int) - coarse.image).mean() < 6
    (deep, first), (_, second) = found[:2], found[2:4]
    assert np.abs(first.image.astype(int) - second.image).mean() > 2  # another z
    assert np.abs(first.image.astype(int) - deep.image).mean() > 2  # another level
    together = predictor.predict_together([
        Request(*(resize_image(one, SMALL) for one in (start, goal))),
        Request(start, goal, *pixels, 3, 2, 4), Request(start, resize_image(goal, SMALL))])
    assert [answer[0].image.shape[0] for answer in together] == [32, 96, 96]
    for one, other in zip(found, together[1], strict=True):
        assert np.abs(one.image.astype(int) - other.image).max() <= 2


def test_a_camera_that_is_squeezed_gets_an_answer_of_its_own_shape():
    whole = {'settings': {'crop': 'whole', 'size': 32}, 'camera_size': [60, 80]}
    start, goal = smooth((120, 160), 2)
    squeezed = SubgoalPredictor(lively_network(), whole)
    subgoal, = squeezed.predict(start, goal, [[80, 60]], [[20, 30]])
    assert subgoal.image.shape == (120, 160, 3) and subgoal.object_maps.shape == (1, *SMALL)
    small, = squeezed.predict(*(resize_image(one, SMALL) for one in (start, goal)))
    assert np.abs(resize_image(subgoal.image, SMALL).astype(int) - small.image).mean() < 4
    for size in ((120, 120 + 32), (24, 32), (16, 16)):
        with pytest.raises(ImageError, match='start: expected 32x32 pixels'):
            squeezed.predict(*smooth(size, 2))
    with pytest.raises(ImageError, match='start: expected 32x32 pixels'):
        SubgoalPredictor(lively_network()).predict(start, goal)  # of an unknown cut
