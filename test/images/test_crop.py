# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What part of a camera's pictures is used: picture, mask and pixels stay together."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_FREE, ROBOT_MASK_HAND
from tap_ros.base.errors import ImageError
from tap_ros.images.crop import Crop, trained_crop, TrainedCrop


@given(st.integers(60, 200), st.integers(60, 200), st.sampled_from(
    ['centre', '7,3,50', '0,0,60', 'whole']),
       st.sampled_from([0, 16, 64, 100]), st.randoms(use_true_random=False))
def test_a_dot_and_its_position_move_together(height, width, part, size, random):
    crop = Crop(part, size)
    left, top, *sides = crop.window((height, width))
    reach = max(max(sides) / (size or min(sides)), 1) + 3  # so that the scaled dot is inside
    u, v = (random.uniform(low + reach, low + side - 1 - reach)
            for low, side in zip((left, top), sides))
    y, x = np.mgrid[:height, :width]
    blob = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * (reach / 3) ** 2))
    picture = np.repeat((255 * blob)[..., None], 3, -1).astype(np.uint8)
    cut = crop.image(picture)
    assert cut.shape[:2] == crop.cut_size((height, width)) == (
        (size, size) if size else tuple(sides[::-1]))
    y, x = np.mgrid[:cut.shape[0], :cut.shape[1]]
    weight = cut[..., 0] / cut[..., 0].sum()
    expected = crop.pixels(np.array([[u, v]], np.float32), (height, width))[0]
    assert expected.dtype == np.float32
    np.testing.assert_allclose([(weight * x).sum(), (weight * y).sum()], expected, atol=0.15)


def test_a_scaled_mask_hides_all_that_the_robot_is_mixed_into():
    rng = np.random.default_rng(1)
    mask = np.full((96, 128), ROBOT_MASK_FREE, np.uint8)
    mask[30:41, 50:57], mask[41:52, 50:57] = ROBOT_MASK_ARM, ROBOT_MASK_HAND
    crop = Crop('centre', 24)
    cut = crop.mask(mask)
    assert cut.shape == (24, 24) and set(np.unique(cut)) == {0, 128, 255}
    # Whatever the robot looks like, pixels that are free are the same.
    bare = rng.integers(0, 256, (96, 128, 3), np.uint8)
    for robot in (0, 255):
        shown = np.where((mask > 0)[..., None], np.uint8(robot), bare)
        same = (crop.image(shown) == crop.image(bare)).all(-1)
        assert same[cut == ROBOT_MASK_FREE].all()
    # And no more is masked than that.
    assert (cut != ROBOT_MASK_FREE).sum() < 4 * (mask > 0).sum() / 16


def trained(part, size, camera=(480, 640), network=64):
    return TrainedCrop(Crop(part, size), camera, (network, network))


def test_pictures_that_stream_in_are_cut_as_in_training():
    assert trained('centre', 64).of((480, 640), 'start') == Crop('centre', 64)
    assert trained('centre', 64).of((720, 1280), 'start') == Crop('centre', 64)  # another camera
    assert trained('centre', 64).unlike((720, 1280), 'start')
    assert not trained('centre', 64).unlike((240, 320), 'start')
    assert trained('80,0,480', 64).of((480, 640), 'start') == Crop('80,0,480', 64)
    assert not trained('centre', 64).of((64, 64), 'start')  # cut already
    assert not trained('', 0, (64, 64)).of((480, 640), 'start')  # never were; it is refused later
    assert trained('8,8,32', 64, (64, 64)).of((64, 64), 'start') == Crop('8,8,32', 64)
    # Cut already, but not scaled:
    assert trained('80,0,480', 64).of((480, 480), 'start') == Crop(size=64)
    assert trained('', 0, (64, 64)).of((100, 100), 'start') == Crop(size=64)
    # Pictures that were not scaled in training are, if the camera has more pixels now.
    assert trained('centre', 0, (64, 80)).of((480, 640), 'start') == Crop('centre', 64)




def test_pictures_are_cut_without_being_made_smaller():
    for crop, size, cut in (
            (trained('centre', 64), (480, 640), Crop('centre')),
            (trained('80,0,480', 64), (480, 640), Crop('80,0,480')),
            (trained('80,0,480', 64), (480, 480), Crop()),
            (trained('whole', 64), (480, 640), Crop('whole')),
            (trained('', 0, (64, 64)), (256, 256), Crop()),
            (trained('centre', 64), (64, 64), Crop()),
            (trained('centre', 64), (48, 96), Crop('centre', 64))):  # it is made larger
        assert crop.unscaled(size, 'start') == cut
        assert crop.is_cut(cut.cut_size(size))
    assert not trained('centre', 64).is_cut((480, 640)) and not trained('', 0).is_cut((32, 32))
    for crop, size in ((trained('80,0,480', 64), (240, 320)),
                       (trained('', 64, (96, 96)), (480, 640))):
        with pytest.raises(ImageError, match='start: '):
            crop.of(size, 'start')


def test_weights_that_tell_no_crop_have_none():
    for training in (
            {}, {'settings': None}, {'settings': {'crop': 'x', 'size': 5}},
            {'settings': {}, 'camera_size': [1]}, {'settings': {'size': '64'}}):
        assert trained_crop(training, (64, 64)) == TrainedCrop(Crop(), None, (64, 64))
