# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the decoders' pretraining."""

from functools import partial

import numpy as np
import pytest
from tap_ros.images.pixels import to_float
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.prediction.pretraining import frame_gan, pretrain_decoders
import torch

COLOUR = np.array([230, 60, 30])


def draw_frames(step, batch=16, size=16):
    """Draw frames of one colour with a dark square somewhere."""
    rng = np.random.default_rng(step)
    frames = np.broadcast_to(COLOUR, (batch, size, size, 3)).astype(np.uint8)
    for frame, (v, u) in zip(frames, rng.integers(0, size - 4, (batch, 2))):
        frame[v:v + 4, u:u + 4] = 20
    return frames


def make(seed=0, **settings):
    torch.manual_seed(seed)
    return Predictor(PredictorConfig(image_size=16, base_width=4, **settings))


def weights(network):
    return {name: value.clone() for name, value in network.state_dict().items()}


def colour_error(generator):
    with torch.no_grad():
        z = torch.randn(64, generator[0].in_channels, 1, 1,
                        generator=torch.Generator().manual_seed(1))
        shown = torch.tanh(generator(z)).mean((0, 2, 3))
    return (shown - to_float(draw_frames(0)).mean((0, 2, 3))).abs().mean()


@pytest.mark.parametrize('settings', [
    {}, {'new_pixels': False}, {'num_context': 1}, {'latent_size': 8}])
def test_the_decoders_share_what_was_trained(settings):
    network = make(**settings)
    before = weights(network)
    pretrain_decoders(network, draw_frames, 2)
    after, fresh = weights(network), weights(frame_gan(network.config, 0)[0])
    last = len(network.flow_decoder) - 1
    decoders = ['flow_decoder', 'mask_decoder'] + ['pixel_decoder'] * network.config.new_pixels
    for name, value in fresh.items():
        own = name.startswith(f'{last}.')
        for part in decoders:
            mine = after[f'{part}.{name}']
            if own and part != 'pixel_decoder':
                assert mine.equal(before[f'{part}.{name}'])
            else:
                assert mine.equal(after[f'{decoders[-1]}.{name}'])
                assert not mine.equal(value), f'{part}.{name} was not trained'


def test_nothing_else_of_the_network_changes():
    network = make().eval()
    before = weights(network)
    pretrain_decoders(network, draw_frames, 2)
    for name, value in weights(network).items():
        if not name.split('.')[0].endswith('_decoder'):
            assert value.equal(before[name]), name
    assert not network.training
    assert all(weight.requires_grad and weight.grad is None for weight in network.parameters())


def test_it_repeats_bit_for_bit_whatever_the_global_random_numbers():
    ends = []
    for seed in (1, 2):
        network = make(seed)
        state = torch.get_rng_state()
        pretrain_decoders(network, draw_frames, 3, seed=5)
        assert torch.get_rng_state().equal(state)
        ends.append(weights(network.pixel_decoder))
    assert all(value.equal(ends[1][name]) for name, value in ends[0].items())
    pretrain_decoders(network, draw_frames, 3, seed=6)
    assert not network.pixel_decoder[0].weight.equal(ends[0]['0.weight'])


def test_no_steps_leave_the_fresh_generator():
    network = make()
    pretrain_decoders(network, draw_frames, 0, seed=3)
    fresh = weights(frame_gan(network.config, 3)[0])
    assert all(value.equal(fresh[name]) for name, value in weights(network.pixel_decoder).items())


def test_generated_frames_come_to_have_the_colour_of_the_data():
    network = make()
    before = colour_error(frame_gan(network.config, 0)[0])
    pretrain_decoders(network, draw_frames, 60, learning_rate=2e-3)
    assert colour_error(network.pixel_decoder) < before / 2


def test_the_network_still_begins_by_copying():
    network = make()
    pretrain_decoders(network, draw_frames, 20)
    context = torch.rand(8, 2, 3, 16, 16, generator=torch.Generator().manual_seed(0)) * 2 - 1
    assert network(context).flow.abs().mean() < 1


def test_half_precision_and_frames_as_tensors_are_fine():
    network = make().to(memory_format=torch.channels_last)
    pretrain_decoders(network, lambda step: torch.from_numpy(draw_frames(step)), 2,
                      autocast=partial(torch.autocast, 'cpu', torch.bfloat16))
    assert all(weight.dtype == torch.float32 and weight.isfinite().all()
               for weight in network.parameters())
