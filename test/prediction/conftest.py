# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small recordings to train on: two squares that move one after the other."""

import numpy as np
import pytest
from tap_ros.recording.episode import Episode
from tap_ros.recording.writer import EpisodeWriter, write_metadata


def make_episode(seed, length=9, size=32):
    """Draw an episode; object k moves in its half of the time."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(6, size - 10, (2, 2))
    goal = start + rng.uniform(4, 6, (2, 2)) * rng.choice([-1, 1], (2, 2))
    share = np.linspace(0, 2, length)[:, None]
    done = np.concatenate([share.clip(0, 1), (share - 1).clip(0, 1)], 1)  # T, K
    pixels = start + done[..., None] * (goal - start)
    frames = np.full((length, size, size, 3), 40, np.uint8)
    for t, k in np.ndindex(length, 2):
        u, v = np.rint(pixels[t, k]).astype(int)
        frames[t, max(v - 2, 0):v + 3, max(u - 2, 0):u + 3] = (200, 60 + 90 * k, 20)
    poses = np.zeros((length, 2, 7))
    poses[..., :2], poses[..., 6] = pixels / size, 1
    return Episode(
        frames=frames, stamps=np.arange(length) * 250_000_000 + (seed + 1) * 10 ** 11,
        actions=np.zeros((length, 4), np.float32), grippers=np.zeros((length, 4), np.float32),
        object_names=('object_0', 'object_1'), object_pixels=pixels.astype(np.float32),
        object_poses=poses, goal_frame=255 - frames[-1],
        goal_pixels=pixels[-1].astype(np.float32), goal_poses=poses[-1], task='push2',
        seed=seed, outcome='success' if seed % 2 == 0 else 'failure')


@pytest.fixture(scope='session')
def bag(tmp_path_factory):
    """Write 24 episodes of 7 to 11 frames into a bag folder."""
    folder = tmp_path_factory.mktemp('bags') / 'squares'
    folder.mkdir()
    with EpisodeWriter(folder / 'squares_0.mcap') as writer:
        for seed in range(24):
            writer.write(make_episode(seed, length=7 + seed % 5))
    write_metadata(folder)
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Keep decoded recordings out of the user's cache."""
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path_factory.getbasetemp() / 'cache'))
