# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subgoals that went through messages are the same to the last bit."""

import numpy as np
import pytest
from tap_msgs.srv import PredictSubgoal
from tap_ros.errors import ImageError, PlanningError
from tap_ros.messages.subgoals import decode_subgoals, Subgoal
from tap_ros.nodes.ros_messages import encode_subgoal
from tap_ros.nodes.topics import to_stamp

pytestmark = pytest.mark.ros
RNG = np.random.default_rng(0)
NAMES, SIZE = ('cup', 'box'), (8, 8)


def subgoal(sample, level):
    return Subgoal(
        RNG.integers(0, 256, (*SIZE, 3), np.uint8), RNG.random((2, *SIZE), np.float32),
        8 * RNG.random((2, 2), np.float32), np.ones(2, np.float32), sample, level)


def answer(subgoals, names=NAMES):
    return PredictSubgoal.Response(
        success=True, subgoals=[encode_subgoal(s, names, to_stamp(1), 'eye') for s in subgoals],
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
    message = encode_subgoal(subgoal(0, 1), NAMES, to_stamp(5), 'eye')
    for part in (message, message.image, *message.object_maps):
        assert part.header.stamp == to_stamp(5) and part.header.frame_id == 'eye'
    decoded, = decode_subgoals(answer([subgoal(2, 1)]), NAMES[:1], SIZE)
    assert decoded.mass.shape == (1,) and np.isnan(decoded.mass).all()
    decoded, = decode_subgoals(answer([subgoal(2, 1)]), (), SIZE)
    assert decoded.object_maps.shape == (0, *SIZE) and decoded.expected_pixels.shape == (0, 2)


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
