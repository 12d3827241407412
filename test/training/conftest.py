# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small recordings to train on: two squares that move one after the other."""

import dataclasses

from made_episodes import move_squares, write_bag
import numpy as np
import pytest


def make_episode(seed):
    """Draw an episode of 7 to 11 frames whose goal picture is none of them."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(6, 22, (2, 2))
    goal = start + rng.uniform(4, 6, (2, 2)) * rng.choice([-1, 1], (2, 2))
    episode = move_squares(start, goal, length=7 + seed % 5, seed=seed,
                           outcome='success' if seed % 2 == 0 else 'failure')
    return dataclasses.replace(episode, goal_frame=255 - episode.frames[-1])


@pytest.fixture(scope='session')
def bag(tmp_path_factory):
    """Write 24 episodes of 7 to 11 frames into a bag folder."""
    return write_bag(tmp_path_factory.mktemp('bags') / 'squares', map(make_episode, range(24)))
