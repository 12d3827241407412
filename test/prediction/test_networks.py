# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the predictor network."""

import pytest
from tap_ros.errors import ConfigError
from tap_ros.prediction.networks import Predictor, PredictorConfig
import torch

SMALL = PredictorConfig(base_width=4)


def contexts(batch, config=SMALL, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, config.num_context, 3, config.image_size, config.image_size)
    return torch.rand(shape, generator=generator) * 2 - 1


def test_blocks_have_the_sizes_of_appendix_c():
    network, sizes = Predictor(PredictorConfig()), []
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


@pytest.mark.parametrize('new_pixels', [True, False])
@pytest.mark.parametrize('image_size', [32, 64])
def test_outputs_have_the_promised_shapes(new_pixels, image_size):
    config = PredictorConfig(image_size=image_size, base_width=4, new_pixels=new_pixels)
    answer = Predictor(config)(contexts(3, config))
    S = image_size
    assert answer.image.shape == (3, 3, S, S)
    assert answer.flow.shape == (3, 2, 2, S, S)
    assert answer.masks.shape == (3, 2 + new_pixels, 1, S, S)
    assert answer.masks.sum(1).allclose(torch.ones(3, 1, S, S))
    if new_pixels:
        assert answer.new_pixels.shape == (3, 3, S, S)
        assert answer.new_pixels.abs().max() <= 1
    else:
        assert answer.new_pixels is None


def test_fresh_weights_hardly_move_anything():
    assert Predictor(SMALL)(contexts(4)).flow.abs().mean() < 1


def test_equal_context_pictures_are_all_that_a_warp_only_network_can_show():
    # Blending warped copies of one flat colour gives that colour.
    network = Predictor(PredictorConfig(base_width=4, new_pixels=False))
    context = torch.full((2, 2, 3, 64, 64), 0.3)
    assert network(context).image.allclose(torch.full((2, 3, 64, 64), 0.3), atol=1e-5)


def test_one_at_a_time_equals_a_batch_in_eval_mode():
    network = Predictor(SMALL)
    for seed in range(3):
        network(contexts(8, seed=seed))  # statistics of batch norm
    network.eval()
    context = contexts(64)
    together = network(context)
    for b in (0, 40):
        alone = network(context[b:b + 1])
        assert alone.image[0].allclose(together.image[b], atol=1e-4)
        assert alone.flow[0].allclose(together.flow[b], atol=1e-3)


def test_memory_format_changes_no_number():
    network = Predictor(SMALL).eval()
    expected = network(contexts(2)).image
    network.to(memory_format=torch.channels_last)
    assert network(contexts(2)).image.allclose(expected, atol=1e-5)


def test_z_makes_a_difference_and_its_mean_is_the_default():
    config = PredictorConfig(base_width=4, latent_size=32)
    network = Predictor(config).eval()
    assert network.flow_decoder[0].in_channels == 160  # section App. C: 128 + 32
    context = contexts(2, config)
    default = network(context).image
    assert network(context, torch.zeros(2, 32)).image.equal(default)
    assert not network(context, torch.ones(2, 32)).image.allclose(default)


def test_every_weight_gets_a_gradient():
    network = Predictor(PredictorConfig(base_width=4, new_pixels=True))
    network(contexts(2)).image.square().mean().backward()
    without = [name for name, weight in network.named_parameters()
               if weight.grad is None or not weight.grad.abs().sum() > 0]
    assert without == []


@pytest.mark.parametrize('values', [{'image_size': 48}, {'image_size': 8}, {'image_size': 0},
                                    {'base_width': 0}, {'latent_size': -1}])
def test_impossible_shapes_are_refused_by_name(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        PredictorConfig(**values)
