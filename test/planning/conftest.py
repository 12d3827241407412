# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of the toy world, and a forward model that fits it."""

import pytest
from tap_ros.planning.forward_model import ForwardModel, ForwardModelConfig
from tap_ros.recording.writer import EpisodeWriter, write_metadata
import torch
from toy_world import ARM, make_episode, SIZE, TABLE


@pytest.fixture(scope='session')
def bag(tmp_path_factory):
    """Write 60 episodes of the toy world into a bag folder."""
    folder = tmp_path_factory.mktemp('bags') / 'toy'
    folder.mkdir()
    with EpisodeWriter(folder / 'toy_0.mcap') as writer:
        for seed in range(60):
            writer.write(make_episode(seed))
    write_metadata(folder)
    return folder


@pytest.fixture
def model():
    """Build an untrained forward model whose push net predicts something."""
    torch.manual_seed(0)
    return ForwardModel(ForwardModelConfig(TABLE, ARM, image_size=SIZE, width=16)).eval()
