# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the time-agnostic CVAE's recognition network."""

import pytest
from tap_ros.errors import ConfigError
from tap_ros.prediction.networks import PredictorConfig
from tap_ros.prediction.recognition import kl_divergence, Recognition, sample_latent
import torch
from torch.distributions import Normal

SMALL = PredictorConfig(base_width=4, latent_size=32)


def draw(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_kl_is_that_of_torch_and_0_for_the_prior():
    assert kl_divergence(torch.zeros(3, 32), torch.zeros(3, 32)).tolist() == [0, 0, 0]
    mean, log_variance = draw(5, 32), draw(5, 32, seed=1)
    expected = torch.distributions.kl_divergence(
        Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0)).sum(1)
    assert kl_divergence(mean, log_variance).allclose(expected, rtol=1e-4)


def test_samples_have_the_posteriors_mean_and_variance():
    mean, log_variance = torch.tensor([[1.0, -2.0]]), torch.tensor([[0.0, 2.0]])
    z = sample_latent(mean, log_variance, draw(20_000, 2))
    assert z.mean(0).allclose(mean[0], atol=0.1)
    assert z.var(0).allclose(log_variance[0].exp(), rtol=0.05)
    assert sample_latent(mean, log_variance, torch.zeros(1, 2)).equal(mean)
    # They carry gradients to both parameters.
    mean, log_variance = draw(4, 8).requires_grad_(), draw(4, 8, seed=1).requires_grad_()
    noise = draw(4, 8, seed=2)
    sample_latent(mean, log_variance, noise).sum().backward()
    assert mean.grad.equal(torch.ones(4, 8))
    assert log_variance.grad.allclose(noise * (log_variance.detach() / 2).exp() / 2)


def test_it_takes_the_whole_video_and_gives_z():
    for num_images, image_size in ((2, 32), (22, 64)):
        config = PredictorConfig(image_size=image_size, base_width=4, latent_size=32)
        network = Recognition(config, num_images)
        assert network.encoder[0].in_channels == 3 * num_images
        mean, log_variance = network(draw(3, num_images, 3, image_size, image_size).tanh())
        assert mean.shape == log_variance.shape == (3, 32)
    with pytest.raises(ConfigError, match='latent_size'):  # a predictor without z has none
        Recognition(PredictorConfig(base_width=4), 6)


def test_it_begins_near_the_prior_or_with_the_spread_asked_for():
    video = draw(4, 6, 3, 64, 64).tanh()
    assert (kl_divergence(*Recognition(SMALL, 6)(video)) < 1).all()
    for std in (1.0, 0.1):
        _, log_variance = Recognition(SMALL, 6, std)(video)
        assert (log_variance / 2).exp().allclose(torch.tensor(std), rtol=0.2)


def test_every_picture_matters():
    network, video = Recognition(SMALL, 6), draw(2, 6, 3, 64, 64).tanh().requires_grad_()
    mean, log_variance = network(video)
    (mean.square().sum() + log_variance.square().sum()).backward()
    assert (video.grad.abs().sum((-3, -2, -1)) > 0).all()
    without = [name for name, weight in network.named_parameters()
               if weight.grad is None or not weight.grad.abs().sum() > 0]
    assert without == []


def test_no_video_makes_z_infinite():
    network = Recognition(SMALL, 2)
    with torch.no_grad():
        network.head[-1].bias[32:] = torch.linspace(-1e4, 1e4, 32)  # the log variances
    mean, log_variance = network(draw(2, 2, 3, 64, 64).tanh())
    assert kl_divergence(mean, log_variance).max() < 2000
    assert sample_latent(mean, log_variance, draw(2, 32)).abs().max() < 100


def test_memory_format_and_half_precision_change_little():
    network, video = Recognition(SMALL, 4).eval(), draw(2, 4, 3, 64, 64).tanh()
    expected = torch.stack(network(video))
    network.to(memory_format=torch.channels_last)
    assert torch.stack(network(video)).allclose(expected, atol=1e-6)
    with torch.autocast('cpu', torch.bfloat16):
        half = torch.stack(network(video))
    assert half.dtype == torch.float32
    assert half.allclose(expected, atol=0.02 * expected.abs().max().item())
