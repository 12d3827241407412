# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot mask belongs to the picture of its stamp; what is wrong with one costs masks alone."""

import dataclasses
import re

import cv2
from made_bags import camera, read
from made_bags import record as write
from made_episodes import assert_all_equal, cover, make_episode, write_bag
import numpy as np
from tap_ros.messages.topics import COMPRESSED_TYPE
from tap_ros.recording.messages import decode, encode

PERIOD = 0.25  # s


def record(path, pictures, masks, goals=()):
    """Write a bag without marks from lists of (topic, stamp, log time, array)."""
    return write(path, sorted((camera(stamp, values, log, topic) for topic, stamp, log, values in (
        *pictures, *masks, *goals)), key=lambda one: one[3]))


def stream(values, late=0.0, start=1.0):
    """Give arrays the stamps of an episode, and log times so much later, s."""
    topic = '/camera/image_raw' if values.ndim == 4 else '/camera/robot_mask'
    return [(topic, start + t * PERIOD, start + t * PERIOD + late, value)
            for t, value in enumerate(values)]


def test_masks_of_some_episodes_are_those_of_no_other(tmp_path, episodes):
    mixed = [dataclasses.replace(episode, **dict.fromkeys(lacking)) for episode, lacking in zip(
        episodes, (('robot_masks', 'goal_mask'), (), ('robot_masks', 'goal_mask'), (),
                   ('goal_mask',), (), ('robot_masks',)), strict=True)]
    mixed = [dataclasses.replace(e, stamps=e.stamps - e.stamps[0]) for e in mixed]  # all from 0
    found, told = read(write_bag(tmp_path / 'bag', mixed[:3], mixed[3:]))
    assert_all_equal(found, mixed)
    assert len(told) == 2 and all('the masks of these episodes are not used' in t for t in told)


def test_masks_belong_to_the_picture_of_their_stamp_whenever_they_came(tmp_path):
    episode = cover(make_episode())
    for late in (-0.005, 0.001, 3 * PERIOD):
        found, told = read(record(tmp_path / str(late), stream(episode.frames),
                                  stream(episode.robot_masks, late)))
        np.testing.assert_array_equal(found[0].robot_masks, episode.robot_masks)
        assert not told


def test_a_mask_of_another_stamp_or_none_is_not_used(tmp_path):
    episode = cover(make_episode())
    masks = stream(episode.robot_masks)
    topic, stamp, log, values = masks[2]
    other = [*masks[:2], (topic, stamp + 0.001, log, values), *masks[3:]]
    found, (text,) = read(record(tmp_path / 'other', stream(episode.frames), other))
    assert found[0].robot_masks is None and len(found[0]) == 5
    assert '1 of 1 episodes' in text and '1 frames, the first at 1.500000000 s' in text
    masks = [(topic, 0, log, values) for topic, _, log, values in masks]
    found, told = read(record(tmp_path / 'none', stream(episode.frames), masks))
    assert found[0].robot_masks is None and len(told) == 1


def test_a_bad_mask_is_named_and_costs_the_masks_of_its_episode(tmp_path):
    episode = cover(make_episode())
    for number, (at, wrong, words) in enumerate((at, *case) for at in (0, 3) for case in (
            (np.full((8, 12), 1, np.uint8), 'value 1; expected 0 .free., 128 .hand. or 255 .arm.'),
            (np.zeros((4, 6), np.uint8), '6x4 pixels among those of 12x8'),
            (np.zeros((8, 12, 3), np.uint8), "encoding 'rgb8' cannot be used; .*: mono8"),
            (np.zeros((0, 0), np.uint8), 'is empty'))):
        masks = stream(episode.robot_masks, -1e-6)  # before its picture, which tells the size
        masks[at] = *masks[at][:3], wrong
        found, (bad, lacking) = read(record(
            tmp_path / str(number), stream(episode.frames), masks))
        np.testing.assert_array_equal(found[0].frames, episode.frames)
        assert found[0].robot_masks is None
        assert '/camera/robot_mask: 1 message cannot be used' in bad
        assert re.search(words, bad) and '1 of 1 episodes' in lacking


def test_the_mask_of_a_goal_has_the_stamp_of_its_picture(tmp_path):
    episode = cover(make_episode())
    for name, stamp in (('its', 0.5), ('other', 0.5 + 1e-9)):
        found, _ = read(record(
            tmp_path / name, stream(episode.frames), stream(episode.robot_masks), (
                ('/goal/image', 0.5, 0.5, episode.goal_frame),
                ('/goal/robot_mask', stamp, 0.6, episode.goal_mask))))
        np.testing.assert_array_equal(found[0].goal_frame, episode.goal_frame)
        if name == 'other':
            assert found[0].goal_mask is None
        else:
            np.testing.assert_array_equal(found[0].goal_mask, episode.goal_mask)


def test_goals_and_masks_may_be_compressed_wherever_they_may_be_raw(tmp_path):
    def small(one):
        topic, kind, data, log = one
        raw = decode(kind, data)
        pixels = np.frombuffer(raw.data, np.uint8).reshape(raw.height, raw.width, -1)
        png = cv2.imencode('.png', pixels[..., ::-1])[1]
        return f'{topic}/compressed', COMPRESSED_TYPE, encode(COMPRESSED_TYPE, {
            'header': {'stamp': vars(raw.header.stamp)}, 'format': 'png', 'data': png}), log

    episode = cover(make_episode())
    (found,), told = read(write(tmp_path / 'bag', [small(camera(stamp, values, log, topic)) for (
        topic, stamp, log, values) in (
            ('/goal/image', 0.5, 0.5, episode.goal_frame), *stream(episode.frames),
            ('/goal/robot_mask', 0.5, 0.6, episode.goal_mask), *stream(episode.robot_masks))]))
    for name in ('frames', 'robot_masks', 'goal_frame', 'goal_mask'):
        np.testing.assert_array_equal(getattr(found, name), getattr(episode, name))
    assert not told
