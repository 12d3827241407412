# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the discriminators and of the recognition network, and of their losses."""

import pytest
from tap_ros.prediction.networks import PredictorConfig
from tap_ros.training.training_networks import (
    Discriminator,
    discriminator_loss,
    kl_divergence,
    Recognition,
    sample_latent,
)
import torch
from torch.distributions import Normal

SMALL = PredictorConfig(image_size=32, base_width=4, latent_size=8)
STEP, OTHER = torch.tensor([2, 0, 5]), torch.tensor([3, 5, 5])  # 1, 5 and 0 steps apart


def draw(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def test_eq_11_is_written_out():
    real, generated, other = (3 * draw(3, 7, seed=seed) for seed in range(3))
    terms = []
    for b, (t, t_other) in enumerate(zip(STEP, OTHER)):
        p_real, p_generated, p_other = (
            p[b, t].double().sigmoid() for p in (real, generated, other))
        label = max(0, 1 - 0.25 * abs(t - t_other))
        terms.append(-(p_real.log() + (1 - p_generated).log()
                       + label * p_other.log() + (1 - label) * (1 - p_other).log()))
    loss = discriminator_loss(real, generated, other, STEP, OTHER)
    assert loss.item() == pytest.approx(torch.stack(terms).mean().item(), rel=1e-5)


def test_every_weight_and_every_picture_matters():
    config = PredictorConfig(image_size=48, base_width=4, num_context=1, latent_size=8)
    pictures = draw(4, 2, 3, 48, 48).tanh().requires_grad_()
    judge, recognition = Discriminator(config, 38), Recognition(config, 2)
    assert judge.encoder[0].in_channels == recognition.encoder[0].in_channels == 6  # appendix C
    logits = judge(pictures[:, :1], pictures[:, 1])
    mean, log_variance = recognition(pictures)
    assert logits.shape == (4, 38) and mean.shape == log_variance.shape == (4, 8)
    for network, outputs in ((judge, [logits]), (recognition, [mean, log_variance])):
        pictures.grad = None
        sum(output.square().mean() for output in outputs).backward()
        assert (pictures.grad.abs().sum((-3, -2, -1)) > 0).all()
        assert all(weight.grad.abs().sum() > 0 for weight in network.parameters())


def test_kl_is_that_of_torch_and_samples_have_the_posteriors_mean_and_variance():
    mean, log_variance = draw(5, 8), draw(5, 8, seed=1)
    expected = torch.distributions.kl_divergence(
        Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0)).sum(1)
    assert kl_divergence(mean, log_variance).allclose(expected, rtol=1e-4)
    z = sample_latent(mean[:1], log_variance[:1], draw(20_000, 8, seed=2))
    assert z.mean(0).allclose(mean[0], atol=0.1)
    assert z.var(0).allclose(log_variance[0].exp(), rtol=0.05)


def test_recognition_begins_with_the_spread_asked_for():
    video = draw(4, 6, 3, 32, 32).tanh()
    for std in (1.0, 0.1):
        mean, log_variance = Recognition(SMALL, 6, std)(video)
        assert (log_variance / 2).exp().allclose(torch.tensor(std), rtol=0.2)
