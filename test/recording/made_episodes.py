# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Episodes of random numbers, and how to compare episodes."""

import dataclasses

import numpy as np
from tap_ros.recording.episode import Episode


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
        goal_poses=random.normal(size=(K, 7)), task='push2', seed=seed, outcome='success')
    return dataclasses.replace(episode, **changes)


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
