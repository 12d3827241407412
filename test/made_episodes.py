# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Episodes for tests: random numbers, squares, a robot over them; and how to compare them."""

import dataclasses

import numpy as np
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_HAND
from tap_ros.recording.episode import Episode
from tap_ros.recording.writer import EpisodeWriter, write_metadata


def make_episode(seed=0, T=5, K=2, size=(8, 12), start=10**9, **changes):
    """Make an episode up; height and width differ so that swapping them shows."""
    random = np.random.default_rng(seed)
    actions = random.uniform(-0.08, 0.08, (T, 4)).astype(np.float32)
    actions[-1] = 0
    episode = Episode(
        frames=random.integers(0, 256, (T, *size, 3), np.uint8),
        stamps=start + np.arange(T) * 250_000_000,
        actions=actions, grippers=random.normal(size=(T, 4)).astype(np.float32),
        object_names=tuple(f'object_{k}' * (k + 1) for k in range(K)),
        object_pixels=random.uniform(0, 8, (T, K, 2)).astype(np.float32),
        object_poses=random.normal(size=(T, K, 7)),
        goal_frame=random.integers(0, 256, (*size, 3), np.uint8),
        goal_pixels=random.uniform(0, 8, (K, 2)).astype(np.float32),
        goal_poses=random.normal(size=(K, 7)), object_source='tracked' if K else '',
        task='push2', seed=seed, outcome='success')
    return dataclasses.replace(episode, **changes)


def move_squares(start, goal, length=9, size=32, half=2, seed=0, **changes):
    """
    Draw an episode of two squares; each moves in its half of the time, the first one first.

    :param start: pixels (2, 2) as (u, v).
    :param goal: likewise; the last frame shows it.
    :param half: a square has 2 half + 1 pixels a side.
    :param seed: in the metadata and in the stamps.
    :param changes: of fields of the Episode.
    """
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    share = np.linspace(0, 2, length)[:, None]
    done = np.concatenate([share.clip(0, 1), (share - 1).clip(0, 1)], 1)  # T, K
    pixels = start + done[..., None] * (goal - start)
    frames = np.full((length, size, size, 3), 40, np.uint8)
    for t, k in np.ndindex(length, 2):
        u, v = np.rint(pixels[t, k]).astype(int)
        rows, columns = (slice(max(at - half, 0), at + half + 1) for at in (v, u))
        frames[t, rows, columns] = (200, 60 + 90 * k, 20)
    poses = np.zeros((length, 2, 7))
    poses[..., :2], poses[..., 6] = pixels / size, 1
    pixels = pixels.astype(np.float32)
    episode = Episode(
        frames=frames, stamps=np.arange(length) * 250_000_000 + (seed + 1) * 10 ** 11,
        actions=np.zeros((length, 4), np.float32), grippers=np.zeros((length, 4), np.float32),
        object_names=('object_0', 'object_1'), object_pixels=pixels, object_poses=poses,
        goal_frame=frames[-1], goal_pixels=pixels[-1], goal_poses=poses[-1], task='push2',
        seed=seed, outcome='success')
    return dataclasses.replace(episode, **changes)


def write_bag(folder, *files):
    """
    Write a bag folder.

    :param folder: made, and named as the bag.
    :param files: episodes of each file.
    :return: the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number, episodes in enumerate(files):
        with EpisodeWriter(folder / f'{folder.name}_{number}.mcap') as writer:
            for episode in episodes:
                writer.write(episode)
    write_metadata(folder)
    return folder


def assert_equal(found, expected):
    """Compare two episodes field by field, types and NaNs included."""
    for field in dataclasses.fields(Episode):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(b, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape, field.name
            np.testing.assert_array_equal(a, b, field.name)
        else:
            assert type(a) is type(b) and a == b, field.name


def assert_all_equal(found, expected):
    """Compare two lists of episodes."""
    found = list(found)
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert_equal(a, b)


def cover(episode, side=4, seed=0, **changes):
    """
    Draw a robot over the frames and the goal picture of an episode: noise that nothing repeats.

    :param episode: Episode.
    :param side: of the robot's square in pixels; it moves to the right, one pixel a frame. Its
        left half is the hand, its right half the arm. So are the last 2x2 pixels, its base.
    :param seed: of the noise.
    :param changes: of fields of the Episode.
    :return: Episode with robot_masks and goal_mask.
    """
    random = np.random.default_rng([seed, 1])
    T, height, width, _ = episode.frames.shape
    masks = np.zeros((T + 1, height, width), np.uint8)
    masks[:, -2:, -2:] = ROBOT_MASK_ARM
    for t in range(T + 1):
        left = t % max(width - side, 1)
        masks[t, 1:1 + side, left:left + side // 2] = ROBOT_MASK_HAND
        masks[t, 1:1 + side, left + side // 2:left + side] = ROBOT_MASK_ARM
    noise = random.integers(0, 256, (T + 1, height, width, 3), np.uint8)
    goal = [] if episode.goal_frame is None else [episode.goal_frame]
    shown = np.concatenate([episode.frames, *(frame[None] for frame in goal)])
    shown = np.where(masks[:len(shown), ..., None] > 0, noise[:len(shown)], shown)
    return dataclasses.replace(episode, **{
        'frames': shown[:T], 'robot_masks': masks[:T],
        **({'goal_frame': shown[T], 'goal_mask': masks[T]} if goal else {}), **changes})
