# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of messages: what goes in comes out, and what cannot be used is named."""

import array
from dataclasses import replace

from builtin_interfaces.msg import Time
import numpy as np
import pytest
from sensor_msgs.msg import Image
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.base.contract import MAP_ENCODINGS
from tap_ros.base.errors import ImageError, PlanningError
from tap_ros.images.crop import Crop, TrainedCrop
from tap_ros.messages import images, objects
from tap_ros.messages.subgoals import decode_subgoal, decode_subgoals, Subgoal
from tap_ros.ros import topics as ros_topics
from tap_ros.ros.topics import to_stamp

pytestmark = pytest.mark.ros
STAMP = Time(sec=3, nanosec=7)


def picture(height=5, width=7, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def message_of(rows, encoding, width):
    """Make an Image from uint8 rows (height, step)."""
    message = Image(height=rows.shape[0], width=width, step=rows.shape[1], encoding=encoding)
    message.data = array.array('B', rows.tobytes())
    return message


def test_a_picture_survives_the_round_trip_and_rows_may_be_padded():
    message = ros_topics.encode_image(picture(), STAMP, 'camera')
    assert (message.encoding, message.step, message.header.frame_id) == ('rgb8', 21, 'camera')
    assert message.header.stamp == STAMP
    assert np.array_equal(images.decode_image(message, 'start', (5, 7)), picture())
    for padding in (0, 1, 13):
        rows = np.pad(picture()[..., ::-1].reshape(5, -1), ((0, 0), (0, padding)))
        message = message_of(rows, 'bgr8', 7)
        message.is_bigendian = padding and 1  # means nothing for bytes
        assert np.array_equal(images.decode_image(message, 'start'), picture())


@pytest.mark.parametrize('change, words', [
    ({'encoding': 'yuv444'}, ['yuv444', 'rgb8', 'bgr8', 'mono8']),
    ({'step': 20}, ['step', '20', '21']),
    ({'height': 0}, ['empty', '7x0']),
    ({'data': array.array('B', bytes(104))}, ['data', '104', '105']),
    ({'encoding': 'x\n\x1b' + 1000 * 'y'}, ["'x\\n\\x1byyy", 'rgb8']),
    ({'height': 2**22, 'data': array.array('B', bytes(2**25 + 1))}, ['33554433', '33554432']),
])
def test_a_bad_picture_is_refused_with_the_reason(change, words):
    message = ros_topics.encode_image(picture(), STAMP, 'camera')
    for field, value in change.items():
        setattr(message, field, value)
    with pytest.raises(ImageError) as error:
        images.decode_image(message, 'goal')
    for word in ['goal', *words]:
        assert word in str(error.value)
    assert str(error.value).isprintable() and len(str(error.value)) < 400
    with pytest.raises(ImageError, match='expected 4x3 .* got 7x5'):
        images.decode_image(ros_topics.encode_image(picture(), STAMP, ''), 'start', (3, 4))


def test_a_map_survives_the_round_trip_in_either_byte_order_and_is_finite():
    values = np.random.default_rng(1).random((5, 7), np.float32)
    message = ros_topics.make_message(Image, images.map_fields(values, STAMP, 'camera'))
    assert np.array_equal(images.decode_map(message, 'map'), values)
    message.data = array.array('B', values.astype('>f4').tobytes())
    message.is_bigendian = 1
    assert np.array_equal(images.decode_map(message, 'map'), values)
    for value in (np.nan, np.inf):
        values[2, 3] = value
        with pytest.raises(ImageError, match='map of red: .*finite'):
            images.decode_map(ros_topics.make_message(
                Image, images.map_fields(values, STAMP, 'camera')), 'map of red')
    with pytest.raises(ImageError, match='32FC1'):
        images.decode_map(ros_topics.encode_image(picture(), STAMP, ''), 'map')


def some_objects(pixels, names=('red', 'blue')):
    poses = np.arange(7 * len(names)).reshape(-1, 7)
    return ros_topics.encode_objects(
        names, pixels, poses, STAMP, 'world', ObjectStates.SOURCE_TRACKED)


def test_objects_survive_the_round_trip_and_are_matched_by_name():
    pixels = np.array([[1.25, 2.5], [3, -4]], np.float32)
    message = some_objects(pixels)
    pose = message.objects[1].pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (7, 8, 9)
    turned = pose.orientation
    assert (turned.x, turned.y, turned.z, turned.w) == (10, 11, 12, 13)
    assert message.source == ObjectStates.SOURCE_TRACKED
    names, decoded = objects.decode_objects(message, 'objects')
    assert names == ('red', 'blue') and np.array_equal(decoded, pixels)
    matched = objects.match_objects(('blue',), names, decoded, 'start', 'goal')
    assert np.array_equal(matched, pixels[1:])
    with pytest.raises(PlanningError, match='goal: lacks green of start; it has red, blue'):
        objects.match_objects(('green', 'red'), names, decoded, 'start', 'goal')
    assert objects.decode_objects(ObjectStates(), 'objects')[1].shape == (0, 2)


@pytest.mark.parametrize('pixels, names, words', [
    ([[1, 2], [np.nan, 3]], ('red', 'blue'), ['blue', 'nan']),
    ([[np.inf, 2], [1, 3]], ('red', 'blue'), ['red', 'inf']),
    ([[1, 2], [1, 3]], ('red', 'red'), ['objects[1].name', 'red']),
    ([[1, 2], [1, 3]], ('', 'red'), ['objects[0].name']),
    ([[1, 2], [np.nan, 3]], ('red', 'a\n\x1b[2J'), ['a\\n\\x1b[2J', 'nan']),
    ([[1, 2], [1, 3]], ('red', 101 * 'x'), ['objects[1].name', '101', '100']),
    (33 * [[1, 2]], [f'cup {n}' for n in range(33)], ['33 objects', '32']),
])
def test_unusable_objects_are_refused_with_the_reason(pixels, names, words):
    with pytest.raises(PlanningError) as error:
        objects.decode_objects(some_objects(pixels, names), 'goal_objects')
    for word in ['goal_objects', *words]:
        assert word in str(error.value)
    assert str(error.value).isprintable()


def test_pixels_outside_the_picture_are_refused_with_the_bounds():
    for pixel in ((63.6, 5), (-0.6, 5), (5, 47.6), (5, -0.6), (5.4e8, 5)):
        message = some_objects([[1, 2], pixel])
        objects.decode_objects(message, 'objects')  # of no known picture
        with pytest.raises(PlanningError, match='objects: blue.*-0.5 to 63.5.*-0.5 to 47.5'):
            objects.decode_objects(message, 'objects', (48, 64))
    border = some_objects([[-0.5, 47.5], [63.5, -0.5]])
    assert len(objects.decode_objects(border, 'objects', (48, 64))[0]) == 2


def test_an_object_beside_the_part_that_the_weights_see_is_named():
    cut = TrainedCrop(Crop('centre', 64), (480, 640), (64, 64)).of((480, 640), 'start')
    with pytest.raises(PlanningError, match=r'start: red not in the part of the picture that the '
                                            r'weights see, 480x480 pixels from \(80, 0'):
        objects.decode_cut_objects(
            some_objects([[20, 200], [100, 200]]), 'start', (480, 640), cut)


# Subgoals

RNG = np.random.default_rng(0)
NAMES, SIZE = ('cup', 'box'), (8, 8)


def subgoal(sample, level):
    return Subgoal(
        RNG.integers(0, 256, (*SIZE, 3), np.uint8), RNG.random((2, *SIZE), np.float32),
        8 * RNG.random((2, 2), np.float32), np.ones(2, np.float32), sample, level)


def answer(subgoals, names=NAMES):
    return PredictSubgoal.Response(
        success=True, subgoals=[
            ros_topics.encode_subgoal(s, names, to_stamp(1), 'eye') for s in subgoals],
        sample=[s.sample for s in subgoals], level=[s.level for s in subgoals])


def test_what_was_encoded_is_decoded_in_the_order_asked_for():
    sent = [subgoal(0, 2), subgoal(0, 1), subgoal(1, 2), subgoal(1, 1)]
    for names, order in ((NAMES, [0, 1]), (NAMES[::-1], [1, 0]), (('box',), [1])):
        for got, true in zip(decode_subgoals(answer(sent), names, SIZE), sent, strict=True):
            assert (got.sample, got.level) == (true.sample, true.level)
            np.testing.assert_array_equal(got.image, true.image)
            np.testing.assert_array_equal(got.object_maps, true.object_maps[order])
            np.testing.assert_array_equal(got.expected_pixels, true.expected_pixels[order])
            assert got.expected_pixels.dtype == np.float32


def test_a_subgoal_carries_the_stamp_and_frame_of_the_picture_and_may_have_no_objects():
    message = ros_topics.encode_subgoal(subgoal(0, 1), NAMES, to_stamp(5), 'eye')
    for part in (message, message.image, *message.object_maps):
        assert part.header.stamp == to_stamp(5) and part.header.frame_id == 'eye'
    decoded, = decode_subgoals(answer([subgoal(2, 1)]), NAMES[:1], SIZE)
    assert decoded.mass.shape == (1,) and np.isnan(decoded.mass).all()
    decoded, = decode_subgoals(answer([subgoal(2, 1)]), (), SIZE)
    assert decoded.object_maps.shape == (0, *SIZE) and decoded.expected_pixels.shape == (0, 2)


@pytest.mark.parametrize('shares, undecided', [
    ((1, 0), False), ((0.8, 0.2), False), ((0.7, 0.3), True), ((0.5, 0.5), True)])
def test_a_map_of_two_places_is_undecided(shares, undecided):
    maps = np.zeros((2, 64, 64), np.float32)
    maps[:, 20, 20], maps[0, 20, 23] = (1, 0.5), 0
    maps[1, 20, 20], maps[1, 40, 30] = shares
    one = replace(subgoal(0, 1), object_maps=maps)
    assert one.undecided.tolist() == [False, undecided]
    assert replace(one, object_maps=maps[:0]).undecided.tolist() == []


def test_a_map_is_decided_wherever_its_place_is_and_undecided_where_it_is_spread_out():
    maps = np.zeros((3, 64, 64), np.float32)
    maps[0, [20, 22, 24, 25, 26], 5] = maps[1, [44, 42, 40, 39, 38], 5] = 0.2
    maps[2] = 1 / 64 ** 2
    one = replace(subgoal(0, 1), object_maps=maps)
    assert one.undecided.tolist() == [False, False, True]


def test_maps_may_be_bytes_or_left_out_unless_they_are_needed():
    sent, names = subgoal(0, 1), (*NAMES, 'lost')
    sent = replace(sent, object_maps=np.concatenate([sent.object_maps, np.zeros((1, *SIZE))]),
                   expected_pixels=np.zeros((3, 2), np.float32))
    for encoding in MAP_ENCODINGS:
        message = ros_topics.encode_subgoal(sent, names, to_stamp(1), 'eye', encoding)
        if encoding == 'none':
            assert decode_subgoal(message, names).object_maps.shape == (0, *SIZE)
            with pytest.raises(PlanningError, match='0 object_maps and 3 expected_pixels'):
                decode_subgoal(message, names, SIZE)
        elif encoding == 'mono8':
            maps = sent.object_maps / np.maximum(sent.object_maps.sum((1, 2), keepdims=True), 1)
            np.testing.assert_allclose(
                decode_subgoal(message, names, SIZE).object_maps, maps, atol=1e-4)
        else:
            got = decode_subgoal(message, names, SIZE)
            np.testing.assert_array_equal(got.object_maps, sent.object_maps)


def test_the_picture_of_a_subgoal_may_be_larger_than_its_maps():
    sent = replace(subgoal(0, 1), image=RNG.integers(0, 256, (40, 56, 3), np.uint8))
    for size in (SIZE, None):
        got, = decode_subgoals(answer([sent]), NAMES, size)
        np.testing.assert_array_equal(got.image, sent.image)
        np.testing.assert_array_equal(got.object_maps, sent.object_maps)
    response = answer([sent])
    response.subgoals[0].object_maps[1] = ros_topics.encode_subgoal(
        replace(sent, object_maps=np.zeros((2, 16, 16), np.float32)), NAMES, to_stamp(1),
        'eye').object_maps[1]
    with pytest.raises(ImageError, match='object map of box: expected 8x8 .* got 16x16'):
        decode_subgoals(response, NAMES)


def test_answers_that_lack_something_are_refused_with_what():
    good = [subgoal(0, 1)]
    for change, words in (
            (lambda r: r.subgoals.clear(), '0 subgoals'),
            (lambda r: setattr(r, 'level', []), '1 entries of sample and 0 of level'),
            (lambda r: setattr(r, 'sample', [0, 1]), '2 entries of sample and 1 of level'),
            (lambda r: r.subgoals[0].object_maps.pop(), '1 object_maps and 2 expected_pixels'),
            (lambda r: r.subgoals[0].expected_pixels.pop(), '2 object_maps and 1 expected_pixels'),
            (lambda r: setattr(r.subgoals[0].object_maps[1], 'height', 4),
             'object map of box: expected 8x8 .* got 8x4'),
            (lambda r: setattr(r.subgoals[0].expected_pixels[0], 'x', float('nan')),
             'expected_pixels hold NaN')):
        response = answer(good)
        change(response)
        with pytest.raises((PlanningError, ImageError), match=words):
            decode_subgoals(response, NAMES, SIZE)
    with pytest.raises(PlanningError, match='subgoal: lacks jug'):
        decode_subgoals(answer(good), ('cup', 'jug'), SIZE)
    with pytest.raises(ImageError, match='16x16.*8x8'):
        decode_subgoals(answer(good), NAMES, (16, 16))
