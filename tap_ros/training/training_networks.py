# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The networks that only training needs, and their losses: GAN (section 3.3) and CVAE (section 3.4).

Both are the predictor's encoder with other ends (appendix C).
"""

import math

from tap_ros.prediction.networks import encoder, initialise, PredictorConfig
import torch
from torch import nn
from torch.nn import functional

SMOOTHING = 0.25  # alpha of appendix A
_LOG_VARIANCE_RANGE = (-10.0, 4.0)


class Discriminator(nn.Module):
    """
    The discriminators D_t of Eq. 11: one network with an output for each target time.

    It has batch norm: hand it real and generated pictures in batches of their own.

    :param config: PredictorConfig of the predictor that it is trained against.
    :param num_times: |T|.
    """

    def __init__(self, config: PredictorConfig, num_times: int) -> None:
        super().__init__()
        self.encoder = encoder(3 * (config.num_context + 1), config.widths)
        self.head = _head(config, num_times)
        self.apply(initialise)

    def forward(self, context: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """
        Judge pictures.

        :param context: (B, C, 3, H, W) in [-1, 1]; image: (B, 3, H, W) in [-1, 1].
        :return: float32 (B, num_times) logits; above 0 means: the true frame at that time.
        """
        pictures = torch.cat([context, image[:, None]], 1).flatten(1, 2)  # B, 3(C+1), H, W
        pictures = pictures.contiguous(memory_format=torch.channels_last)
        return self.head(self.encoder(pictures)).flatten(1).float()


def _head(config: PredictorConfig, outputs: int) -> nn.Sequential:
    """Build what makes (B, outputs, 1, 1) of the encoder's last block."""
    width = config.widths[-1]
    return nn.Sequential(nn.Conv2d(width, width, 3, padding=1), nn.ReLU(),
                         nn.Conv2d(width, outputs, config.coarsest))


def smoothed_labels(step: torch.Tensor, other_step: torch.Tensor) -> torch.Tensor:
    """Return the labels l_{t,t'} = max(0, 1 - alpha |t - t'|) of appendix A for int t and t'."""
    return (1 - SMOOTHING * (step - other_step).abs().float()).clamp(min=0)


def discriminator_loss(real: torch.Tensor, generated: torch.Tensor, other: torch.Tensor,
                       step: torch.Tensor, other_step: torch.Tensor) -> torch.Tensor:
    """
    Compute the discriminators' loss, to be minimised, at t = step.

    -log D_t(c, x_t) - log(1 - D_t(c, G(c))) - sum_t' [l log D_t(c, x_t') + (1 - l) log(1 - D_t(c,
    x_t'))] with l = l_{t,t'} of smoothed_labels (Eq. 11 with its sign changed). The sum over t' is
    approximated by one frame, as in section 3.3.

    :param real: (B, |T|) logits of D(c, x_t); generated: of D(c, G(c)); other: of D(c, x_t').
    :param step: int64 (B,), t as an index into |T|; other_step: int64 (B,), t'.
    :return: scalar: the sum of the three cross entropies, as a mean over the batch.
    """
    real, generated, other = (
        logits.gather(1, step[:, None])[:, 0] for logits in (real, generated, other))
    entropy = functional.binary_cross_entropy_with_logits
    return (entropy(real, torch.ones_like(real))
            + entropy(generated, torch.zeros_like(generated))
            + entropy(other, smoothed_labels(step, other_step)))


def generator_loss(generated: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """
    Compute the predictor's side, -log D_t(c, G(c)): Eq. 11 in the form that does not saturate.

    :param generated: (B, |T|) logits of D(c, G(c)).
    :param step: int64 (B,), t as an index into |T|.
    :return: scalar: a mean over the batch.
    """
    logits = generated.gather(1, step[:, None])[:, 0]
    return functional.softplus(-logits).mean()


class Recognition(nn.Module):
    """
    The recognition network q_phi(z | X) of Eq. 9: infer z from pictures, usually a whole video.

    :param config: PredictorConfig of the predictor that takes z.
    :param num_images: how many pictures it takes.
    :param initial_std: standard deviation of z that it begins with.
    """

    def __init__(self, config: PredictorConfig, num_images: int,
                 initial_std: float = 1.0) -> None:
        super().__init__()
        self.encoder = encoder(3 * num_images, config.widths)
        self.head = _head(config, 2 * config.latent_size)
        self.apply(initialise)
        with torch.no_grad():
            self.head[-1].get_parameter('bias')[config.latent_size:] = 2 * math.log(initial_std)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Infer mean and log variance of z, float32 (B, latent_size), from (B, N, 3, H, W)."""
        images = images.flatten(1, 2).contiguous(memory_format=torch.channels_last)
        mean, log_variance = self.head(self.encoder(images)).flatten(1).float().chunk(2, 1)
        return mean, log_variance.clamp(*_LOG_VARIANCE_RANGE)


def sample_latent(mean: torch.Tensor, log_variance: torch.Tensor,
                  noise: torch.Tensor) -> torch.Tensor:
    """Draw z from the posterior by standard normal noise, so that gradients reach both."""
    return mean + torch.exp(log_variance / 2) * noise


def kl_divergence(mean: torch.Tensor, log_variance: torch.Tensor) -> torch.Tensor:
    """
    Compute the divergence of the posterior from the prior N(0, I) (Eqs. 8 to 10).

    D_KL(q_phi(z | X), p(z)) = 1/2 sum (mu^2 + sigma^2 - 1 - log sigma^2).

    :param mean: (B, latent_size); log_variance: (B, latent_size).
    :return: (B,), in nats, the sum over the dimensions of z.
    """
    return (mean ** 2 + log_variance.exp() - 1 - log_variance).sum(1) / 2
