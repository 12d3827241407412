# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the predictor network."""

from dataclasses import replace

import pytest
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
import torch

SMALL = PredictorConfig(base_width=4)
SHARED = PredictorConfig(base_width=4, decoder='shared')
SKIPS = PredictorConfig(base_width=4, decoder='shared', skips=True)
EVERY = pytest.mark.parametrize('config', [SMALL, SHARED, SKIPS], ids=['paper', 'shared', 'skips'])


def contexts(batch, config=SMALL, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, config.num_context, 3, config.image_size, config.image_size)
    return torch.rand(shape, generator=generator) * 2 - 1


def test_blocks_have_the_sizes_of_appendix_c():
    network, sizes = PredictorNetwork(PredictorConfig()), []
    convolutions = [layer for part in (network.encoder, network.head, network.mask_decoder)
                    for layer in part
                    if isinstance(layer, (torch.nn.Conv2d, torch.nn.ConvTranspose2d))]
    for layer in convolutions:
        layer.register_forward_hook(lambda _, __, out: sizes.append(tuple(out.shape[1:])))
    network(contexts(1))
    assert sizes == [
        (32, 32, 32), (64, 16, 16), (128, 8, 8), (256, 4, 4),              # encoder
        (256, 4, 4), (128, 1, 1),                                          # head
        (256, 4, 4), (128, 8, 8), (64, 16, 16), (32, 32, 32), (3, 64, 64)]  # decoder
    assert network.head[0].in_channels == 512


@EVERY
def test_outputs_have_the_promised_shapes_and_fresh_weights_hardly_move_anything(config):
    for S, new_pixels in ((48, True), (64, False)):
        config = replace(config, image_size=S, new_pixels=new_pixels)
        answer = PredictorNetwork(config)(contexts(3, config))
        assert answer.image.shape == (3, 3, S, S)
        assert answer.flow.shape == (3, 2, 2, S, S) and answer.flow.abs().mean() < 1
        assert answer.masks.shape == (3, 2 + new_pixels, 1, S, S)
        assert answer.masks.sum(1).allclose(torch.ones(3, 1, S, S))
        assert (answer.new_pixels is not None) == new_pixels


@EVERY
def test_every_weight_gets_a_gradient(config):
    network = PredictorNetwork(config)
    network(contexts(2)).image.square().mean().backward()
    without = [name for name, weight in network.named_parameters()
               if weight.grad is None or not weight.grad.abs().sum() > 0]
    assert without == []
