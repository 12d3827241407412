# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictors that move and blend visibly without being trained."""

from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
import torch
from torch import nn


def lively_network(seed=0, **config):
    """
    Make a small predictor whose flow is some pixels long and depends on pictures and z.

    Fresh weights predict a copy: in evaluation mode almost nothing gets through their layers.
    """
    torch.manual_seed(seed)
    config = PredictorConfig(**{'image_size': 32, 'base_width': 4, 'new_pixels': False, **config})
    network = PredictorNetwork(config)
    nn.init.normal_(network.flow_decoder[-1].weight, 0.0, 0.02)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = 1.0  # statistics are those of the batch below
    context = torch.rand(16, config.num_context, 3, config.image_size, config.image_size) * 2 - 1
    network.train()(context, torch.randn(16, config.latent_size) if config.latent_size else None)
    return network.eval()
