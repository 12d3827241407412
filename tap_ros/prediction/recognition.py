# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recognition network q_phi(z | X) of the time-agnostic CVAE (section 3.4, Eq. 9)."""

import math

from tap_ros.errors import ConfigError
from tap_ros.prediction.networks import encoder, initialise, PredictorConfig
import torch
from torch import nn

# One strange batch must not end a training: far outside, exp() makes the noise and the KL
# divergence huge or infinite. The prior's log variance is 0.
_LOG_VARIANCE_RANGE = (-10.0, 4.0)


class Recognition(nn.Module):
    """
    Infer z from pictures, usually a whole video.

    The predictor's encoder with other ends (appendix C): it takes |C| + |T| pictures, and gives
    the mean and the log variance of z.

    :param config: PredictorConfig of the predictor that takes z.
    :param num_images: how many pictures it takes.
    :param initial_std: standard deviation of z that it begins with.
    :raises ConfigError: if that predictor has no z.
    """

    def __init__(self, config: PredictorConfig, num_images: int,
                 initial_std: float = 1.0) -> None:
        super().__init__()
        if config.latent_size < 1:
            raise ConfigError('latent_size: a recognition network needs at least 1, got '
                              f'{config.latent_size}; the paper has 32')
        widths = config.widths
        self.encoder = encoder(3 * num_images, widths)
        self.head = nn.Sequential(
            nn.Conv2d(widths[-1], widths[-1], 3, padding=1), nn.ReLU(),
            nn.Conv2d(widths[-1], 2 * config.latent_size, 4))
        self.apply(initialise)
        with torch.no_grad():
            self.head[-1].get_parameter('bias')[config.latent_size:] = 2 * math.log(initial_std)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Infer the posterior.

        :param images: (B, num_images, 3, H, W) in [-1, 1].
        :return: mean and log variance, each float32 (B, latent_size).
        """
        images = images.flatten(1, 2).contiguous(memory_format=torch.channels_last)
        mean, log_variance = self.head(self.encoder(images)).flatten(1).float().chunk(2, 1)
        return mean, log_variance.clamp(*_LOG_VARIANCE_RANGE)


def sample_latent(mean: torch.Tensor, log_variance: torch.Tensor,
                  noise: torch.Tensor) -> torch.Tensor:
    """
    Draw z from the posterior, so that gradients reach its parameters.

    :param mean: (B, latent_size).
    :param log_variance: (B, latent_size).
    :param noise: (B, latent_size), standard normal.
    :return: (B, latent_size).
    """
    return mean + torch.exp(log_variance / 2) * noise


def kl_divergence(mean: torch.Tensor, log_variance: torch.Tensor) -> torch.Tensor:
    """
    Compute the divergence of the posterior from the prior N(0, I) (Eqs. 8 to 10).

    D_KL(q_phi(z | X), p(z)) = 1/2 sum (mu^2 + sigma^2 - 1 - log sigma^2).

    :param mean: (B, latent_size).
    :param log_variance: (B, latent_size).
    :return: (B,), in nats, the sum over the dimensions of z.
    """
    return (mean ** 2 + log_variance.exp() - 1 - log_variance).sum(1) / 2
