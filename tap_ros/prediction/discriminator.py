# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The time-agnostic conditional GAN (section 3.3, appendix A)."""

from tap_ros.prediction.networks import encoder, initialise, PredictorConfig
import torch
from torch import nn
from torch.nn import functional

SMOOTHING = 0.25  # alpha of appendix A


class Discriminator(nn.Module):
    """
    The discriminators D_t of Eq. 11: one network with an output for each target time.

    The predictor's encoder with other ends (appendix C): it takes the context pictures and the
    picture to judge, and gives |T| logits. It has batch norm: hand it real and generated pictures
    in batches of their own.

    :param config: PredictorConfig of the predictor that it is trained against.
    :param num_times: |T|.
    """

    def __init__(self, config: PredictorConfig, num_times: int) -> None:
        super().__init__()
        widths = config.widths
        self.encoder = encoder(3 * (config.num_context + 1), widths)
        self.head = nn.Sequential(
            nn.Conv2d(widths[-1], widths[-1], 3, padding=1), nn.ReLU(),
            nn.Conv2d(widths[-1], num_times, 4))
        self.apply(initialise)

    def forward(self, context: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """
        Judge pictures.

        :param context: (B, C, 3, H, W) in [-1, 1].
        :param image: (B, 3, H, W) in [-1, 1].
        :return: float32 (B, num_times) logits; above 0 means: the true frame at that time.
        """
        pictures = torch.cat([context, image[:, None]], 1).flatten(1, 2)  # B, 3(C+1), H, W
        pictures = pictures.contiguous(memory_format=torch.channels_last)
        return self.head(self.encoder(pictures)).flatten(1).float()


def smoothed_labels(step: torch.Tensor, other_step: torch.Tensor,
                    alpha: float = SMOOTHING) -> torch.Tensor:
    """
    Compute the labels l_{t,t'} = max(0, 1 - alpha |t - t'|) of appendix A.

    :param step: int (...), t.
    :param other_step: int (...), t'.
    :param alpha: how fast frames beside t stop being positives.
    :return: (...), 1 at t, 0 far from it.
    """
    return (1 - alpha * (step - other_step).abs().float()).clamp(min=0)


def discriminator_loss(real: torch.Tensor, generated: torch.Tensor, other: torch.Tensor,
                       step: torch.Tensor, other_step: torch.Tensor,
                       alpha: float = SMOOTHING) -> torch.Tensor:
    """
    Compute the discriminators' loss, to be minimised, at t = step.

    -log D_t(c, x_t) - log(1 - D_t(c, G(c))) - sum_t' [l log D_t(c, x_t') + (1 - l) log(1 - D_t(c,
    x_t'))] with l = l_{t,t'} of smoothed_labels (Eq. 11 with its sign changed). The sum over t' is
    approximated by one frame, as in section 3.3.

    :param real: (B, |T|) logits of D(c, x_t).
    :param generated: (B, |T|) logits of D(c, G(c)).
    :param other: (B, |T|) logits of D(c, x_t').
    :param step: int64 (B,), t as an index into |T|.
    :param other_step: int64 (B,), t'.
    :param alpha: of smoothed_labels.
    :return: scalar: the sum of the three cross entropies, as a mean over the batch.
    """
    real, generated, other = (
        logits.gather(1, step[:, None])[:, 0] for logits in (real, generated, other))
    entropy = functional.binary_cross_entropy_with_logits
    return (entropy(real, torch.ones_like(real))
            + entropy(generated, torch.zeros_like(generated))
            + entropy(other, smoothed_labels(step, other_step, alpha)))


def generator_loss(generated: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """
    Compute the predictor's side, -log D_t(c, G(c)): Eq. 11 in the form that does not saturate.

    :param generated: (B, |T|) logits of D(c, G(c)).
    :param step: int64 (B,), t as an index into |T|.
    :return: scalar: -log D_t(c, G(c)) as a mean over the batch.
    """
    logits = generated.gather(1, step[:, None])[:, 0]
    return functional.softplus(-logits).mean()
