# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the predictor is trained to do: from a batch to its loss."""

import contextlib
from dataclasses import dataclass, replace
import math
from typing import Self

import numpy as np
from tap_ros.prediction.losses import (
    match_step,
    recursive_loss,
    remaining_targets,
    total,
)
from tap_ros.prediction.networks import Prediction, PredictorNetwork
from tap_ros.training.batches import Batch
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.training.selection import selection_errors, Targets
from tap_ros.training.training_networks import (
    discriminator_loss,
    generator_loss,
    kl_divergence,
    Recognition,
    sample_latent,
)
from tap_ros.weights.devices import Autocast
import torch

GAN_WEIGHT = 5e-5  # of the GAN's terms beside the l1 error on [0, 1]
LATENT_SIZE = 32  # length of z


@dataclass(frozen=True)
class Networks:
    """
    The networks that take part in training; which ones, the method says.

    :param predictor: G.
    :param recognition: q_phi (Eq. 9), or None.
    :param discriminator: D_t (Eq. 11), which judges predictions from the prior (or without z), or
        None.
    :param posterior_discriminator: D'_t (Eq. 10), which judges those from the posterior, or None.
    :param autocast: makes the context manager to run them in.
    """

    predictor: PredictorNetwork
    recognition: Recognition | None = None
    discriminator: torch.nn.Module | None = None
    posterior_discriminator: torch.nn.Module | None = None
    autocast: Autocast = contextlib.nullcontext

    def predict(self, context: torch.Tensor, z: torch.Tensor | None) -> Prediction:
        """Return G(c, z) of contexts (B, C, 3, H, W)."""
        with self.autocast():
            return self.predictor(context, z)


@dataclass(frozen=True)
class Draws:
    """
    The random numbers of one training step.

    :param posterior: (B, T, LATENT_SIZE) normal; one z for each target is used with the posterior
        'frame', else the first.
    :param prior: (B, LATENT_SIZE) normal.
    :param other: (B, T) in 0..1, to draw t' of Eq. 11.
    """

    posterior: torch.Tensor
    prior: torch.Tensor
    other: torch.Tensor

    @classmethod
    def make(cls, batch: Batch, seed: int, step: int) -> Self:
        """
        Draw those of a step, on the batch's device, the same ones whenever asked.

        :param batch: batches.Batch.
        :param seed: of the training; step: number of the step.
        :return: Draws.
        """
        rng = np.random.default_rng([seed, 4, step])
        B, T = batch.times.shape
        draws = (rng.standard_normal((B, T, LATENT_SIZE), np.float32),
                 rng.standard_normal((B, LATENT_SIZE), np.float32),
                 rng.random((B, T), np.float32))
        return cls(*(torch.from_numpy(draw).to(batch.times.device) for draw in draws))


@dataclass(frozen=True)
class Judged:
    """
    What the discriminators learn from.

    :param pairs: each discriminator, and the predictions (B, 3, H, W) that it judges.
    :param context: (B, C, 3, H, W); real: (B, 3, H, W), the matched frames; other: the same of
        other times.
    :param step: int64 (B,), the outputs that the matched frames belong to; other_step: (B,)
        of the others.
    """

    pairs: list[tuple[torch.nn.Module, torch.Tensor]]
    context: torch.Tensor
    real: torch.Tensor
    other: torch.Tensor
    step: torch.Tensor
    other_step: torch.Tensor


@dataclass(frozen=True)
class Outcome:
    """
    The loss of a batch and what it came from.

    :param match: int64 (B,), the matched targets as indices into T.
    :param parts: dict of the terms of the loss, scalars with gradient.
    :param judged: what the discriminators learn from, or None (see discriminators_loss).
    :param nats: KL divergence of z, mean over the batch; None without z.
    """

    match: torch.Tensor
    parts: dict[str, torch.Tensor]
    judged: Judged | None = None
    nats: torch.Tensor | None = None

    @property
    def loss(self) -> torch.Tensor:
        """The sum of its terms, scalar with gradient."""
        return total(self.parts.values())


def predictor_loss(networks: Networks, batch: Batch, config: TrainingConfig,
                   draws: Draws | None = None, kl_share: float = 1.0) -> Outcome:
    """
    Compute the predictor's training loss of a batch.

    With E_t = E(x_t, G(c)) and t* chosen by the method (Eqs. 1, 2, 5; summed over levels: 3):

        E_{t*}                                                               no GAN, no VAE
        E_{t*} - log D_{t*}(c, G(c))                                         GAN (Eq. 7)
        D_KL(q(z|X), p(z)) + E_{t*} at z ~ q                                 VAE (Eq. 9)
        the same - log D_{t*}(c, G(c, z ~ p)) - log D'_{t*}(c, G(c, z ~ q))  both (Eq. 10)

    each with its weight. The GAN's terms stand at the matched frame, as in Eq. 10, and are left
    out of the choice.

    :param draws: needed with GAN or VAE.
    :param kl_share: of the weight of the KL divergence at this step, see predictor.kl_share.
    :return: Outcome.
    """
    targets = Targets(batch, config)
    kl_weight = kl_share * config.kl_weight
    parts: dict[str, torch.Tensor] = {}
    z = nats = judged = None
    if networks.recognition is not None:
        assert draws is not None, 'z is drawn'
        if config.posterior == 'frame':
            return _frame_posterior_loss(networks, targets, draws, kl_weight)
        assert batch.video is not None, 'see Sampling.video_frames'
        with networks.autocast():
            mean, log_variance = networks.recognition(targets.augmented(batch.video))
        z = sample_latent(mean, log_variance, draws.posterior[:, 0])
        nats = kl_divergence(mean, log_variance).mean()
        parts['kl'] = kl_weight * (nats - config.free_nats).clamp(min=0)
    prediction = networks.predict(targets.context, z)
    match = targets.match(prediction.image, targets.measured)
    parts['error'] = targets.l1(prediction.image, match).mean()
    if networks.discriminator is not None:
        assert draws is not None, "t' is drawn"
        judged = _judge(networks, targets, prediction, match, draws)
        with networks.autocast():
            parts['gan'] = GAN_WEIGHT * total(
                generator_loss(judge(judged.context, image), judged.step)
                for judge, image in judged.pairs)
    if config.recursion > 1:
        parts['error'] = _recursive_loss(
            networks, targets, prediction, match, parts['error'], z)
    return Outcome(match, parts, judged, nats)


def _judge(networks: Networks, targets: Targets, prediction: Prediction, match: torch.Tensor,
           draws: Draws) -> Judged:
    """Gather what the discriminators see of this batch."""
    assert networks.discriminator is not None
    batch = targets.batch
    pairs = [(networks.discriminator, targets.visible(prediction.image))]
    if networks.posterior_discriminator is not None:
        sampled = networks.predict(targets.context, draws.prior)
        pairs = [(networks.discriminator, targets.visible(sampled.image)),
                 (networks.posterior_discriminator, targets.visible(prediction.image))]
    chance = draws.other.masked_fill(~batch.valid, -1)
    chance[targets.rows, match] = -0.5  # t' is another frame, if there is one
    other = chance.argmax(1)
    # The first output is for time 1: context and target are never the same frame.
    step, other_step = (batch.times.gather(1, at[:, None])[:, 0] - 1 for at in (match, other))
    return Judged(pairs, targets.context, targets.frame(match), targets.frame(other), step,
                  other_step)


def discriminators_loss(judged: Judged,
                        autocast: Autocast = contextlib.nullcontext) -> torch.Tensor:
    """
    Compute the discriminators' own loss (Eq. 11), for predictions without gradient.

    :param judged: of an Outcome.
    :param autocast: makes the context manager to run the networks in.
    :return: scalar with gradient.
    """
    losses = []
    for judge, image in judged.pairs:
        with autocast():  # one batch each: batch norm must not mix real and generated frames
            real, generated, other = (judge(judged.context, frame) for frame in (
                judged.real, image.detach(), judged.other))
        losses.append(discriminator_loss(real, generated, other, judged.step, judged.other_step))
    return total(losses)


def _recursive_loss(networks: Networks, targets: Targets, prediction: Prediction,
                    match: torch.Tensor, loss: torch.Tensor,
                    z: torch.Tensor | None) -> torch.Tensor:
    """
    Add the levels r > 0 of Eq. 3.

    Unlike in the paper, no gradients flow through the predictions as contexts: else the loss of a
    later level bends a picture that serves for itself into one that is easy to go on from.
    """
    config, batch, valid = targets.config, targets.batch, targets.batch.valid
    context, measured = targets.context, targets.measured
    losses, counts = [loss], [len(context)]
    for level in range(1, config.recursion):
        matched = batch.times.gather(1, match[:, None])
        valid = remaining_targets(valid, batch.times, matched, config.forward)
        left = valid.any(1)
        if not left.any():
            break
        # The prediction takes the place of the start (forward) or of the goal.
        following = prediction.image[:, None].detach()
        context, measured = (
            following if config.forward else torch.cat([pictures[:, :1], following], 1)
            for pictures in (context, measured))
        prediction = networks.predict(targets.beside(context, level), z)
        # Preferences lie between the inputs of this level.
        between = replace(batch, valid=valid | ~left[:, None], preference=(
            None if batch.preference is None else batch.preference[:, level:]))
        if not config.forward:
            end = torch.where(left[:, None], matched, batch.end)
            between = replace(between, end=end, last=torch.where(
                left[:, None], matched - 1, batch.last))
        match = targets.match(prediction.image, measured, between)
        errors = targets.l1(prediction.image, match)
        losses.append(errors[left].mean())
        counts.append(int(left.sum().item()))
    return recursive_loss(losses, counts)


def _frame_posterior_loss(networks: Networks, targets: Targets, draws: Draws,
                          kl_weight: float) -> Outcome:
    """
    Compute the alternative of appendix B: the minimum over time of the whole CVAE loss.

    L = min_{t in T} [D_KL(q(z | c, x_t), p(z)) + E(x_t, G(c, z ~ q(z | c, x_t)))].

    Recognition network and predictor run once for every target; num_targets keeps that small. With
    genmin the selection error is that of the whole loss instead of the l1 error.
    """
    batch = targets.batch
    assert networks.recognition is not None
    terms = []
    for t in range(batch.times.shape[1]):
        step = torch.full_like(targets.rows, t)
        with networks.autocast():
            mean, log_variance = networks.recognition(
                torch.cat([targets.context, targets.frame(step)[:, None]], 1))
            z = sample_latent(mean, log_variance, draws.posterior[:, t])
        terms.append((kl_divergence(mean, log_variance),
                      targets.l1(networks.predict(targets.context, z).image, step)))
    divergences, errors = (torch.stack(values, 1) for values in zip(*terms))  # B, T
    whole = (kl_weight * divergences + errors).detach()
    match = match_step(selection_errors(
        lambda wanted: whole.masked_fill(~wanted, math.inf),
        lambda wanted: targets.errors(targets.measured, wanted), batch, targets.config),
        batch.valid)
    nats, error = (values.gather(1, match[:, None]).mean()
                   for values in (divergences, errors))
    return Outcome(match, {'kl': kl_weight * nats, 'error': error}, nats=nats)
