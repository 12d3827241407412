# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of taking the robot out of camera pictures."""

import numpy as np
import pytest
from sensor_msgs.msg import Image
from tap_ros.contract import ROBOT_MASK_ARM, ROBOT_MASK_HAND
from tap_ros.errors import ImageError
from tap_ros.messages.images import decode_mask
from tap_ros.nodes.robot_view import RobotView
from tap_ros.nodes.ros_messages import encode_image
from tap_ros.nodes.topics import to_stamp

SCENE = np.random.default_rng(0).integers(0, 256, (6, 9, 3), np.uint8)


def covered(columns, seed=1):
    """Return the scene with a robot before some columns, and its mask: hand, then arm."""
    mask = np.zeros((6, 9), np.uint8)
    mask[:3, columns], mask[3:, columns] = ROBOT_MASK_HAND, ROBOT_MASK_ARM
    noise = np.random.default_rng(seed).integers(0, 256, SCENE.shape, np.uint8)
    return np.where(mask[..., None] > 0, noise, SCENE), mask


def messages(picture, mask, stamp):
    return encode_image(picture, to_stamp(stamp), 'eye'), mask_message(mask, stamp)


def mask_message(mask, stamp=1, padding=2, **changes):
    """Make a message whose rows are padded."""
    rows = np.pad(mask, ((0, 0), (0, padding)), constant_values=7)
    message = Image(height=mask.shape[0], width=mask.shape[1], encoding='mono8',
                    step=rows.shape[1], data=rows.tobytes())
    message.header.stamp = to_stamp(stamp)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def see(view, columns, stamp, jumps=0):
    return view.see(*messages(*covered(columns, stamp), stamp), jumps)


def test_the_scene_behind_the_robot_is_what_was_seen_last():
    view = RobotView('all')
    first = see(view, [0, 1], 10)
    np.testing.assert_array_equal(first, covered([0, 1], 10)[0])  # nothing else is known
    np.testing.assert_array_equal(see(view, [4, 5], 20), SCENE)
    np.testing.assert_array_equal(see(view, [0, 1], 30), SCENE)


def test_the_hand_stays_with_arm():
    view = RobotView('arm')
    see(view, [], 10)
    picture = see(view, [4, 5], 20)
    np.testing.assert_array_equal(picture[3:], SCENE[3:])
    np.testing.assert_array_equal(picture[:3], covered([4, 5], 20)[0][:3])


def test_what_was_seen_of_another_scene_is_forgotten():
    for jumps in (0, 1):
        view = RobotView('all')
        see(view, [], 20)
        if not jumps:
            view.clear()
        # The same stamps may come again.
        np.testing.assert_array_equal(see(view, [3], 20, jumps), covered([3], 20)[0])
        np.testing.assert_array_equal(see(view, [5], 30, jumps), SCENE)


def test_an_older_picture_is_filled_and_not_remembered():
    view = RobotView('all')
    see(view, [0], 20)
    older = np.full_like(SCENE, 9)
    mask = np.zeros((6, 9), np.uint8)
    mask[:, 8] = ROBOT_MASK_ARM
    seen = view.see(*messages(older, mask, 10), 0)
    np.testing.assert_array_equal(seen[:, :8], older[:, :8])
    np.testing.assert_array_equal(seen[:, 8], SCENE[:, 8])
    np.testing.assert_array_equal(see(view, [4], 30), SCENE)


def test_goals_are_filled_with_what_the_camera_has_seen():
    view = RobotView('all')
    goal, mask = covered([7], 5)
    mask = mask_message(mask)
    np.testing.assert_array_equal(view.fill_goal(goal, mask), goal)
    see(view, [1], 10)
    np.testing.assert_array_equal(view.fill_goal(goal, mask), SCENE)
    np.testing.assert_array_equal(see(view, [1], 20), covered([1], 20)[0])  # as before


def test_masks_are_read_padded_or_refused_with_the_reason():
    mask = covered([2])[1]
    np.testing.assert_array_equal(decode_mask(mask_message(mask), 'mask', (6, 9)), mask)
    free = np.zeros((6, 9), np.uint8)
    for message, words in (
            (mask_message(free + 1), 'mask: a robot mask with the value 1; expected 0'),
            (mask_message(free.T), '9x6 pixels .* got 6x9'),
            (mask_message(free, encoding='rgb8'), "'rgb8' .* valid .*: mono8"),
            (mask_message(free, step=3), 'step is 3 bytes')):
        with pytest.raises(ImageError, match=words):
            decode_mask(message, 'mask', (6, 9))
