# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of the toy world, and a forward model that fits it."""

from made_episodes import write_bag
import pytest
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
import torch
from toy_world import ARM, make_episode, SIZE, TABLE


@pytest.fixture(scope='session')
def bag(tmp_path_factory):
    """Write 30 episodes of the toy world into a bag folder."""
    return write_bag(tmp_path_factory.mktemp('bags') / 'toy', map(make_episode, range(30)))


@pytest.fixture
def model():
    """Build an untrained forward model whose push net predicts something."""
    torch.manual_seed(0)
    return LearnedForwardModel(ForwardModelConfig(TABLE, ARM, image_size=SIZE, width=16)).eval()
