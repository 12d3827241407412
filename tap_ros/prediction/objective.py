# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the predictor is trained to do: from a batch to its loss."""

import contextlib
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from tap_ros.images.pixels import to_float
from tap_ros.prediction.batches import Augmentation, Batch
from tap_ros.prediction.losses import (
    match_step,
    recursive_loss,
    remaining_targets,
    total,
)
from tap_ros.prediction.networks import Prediction, PredictorNetwork
from tap_ros.prediction.selection import selection_errors, Targets
from tap_ros.prediction.training_config import ObjectiveSettings
from tap_ros.prediction.training_networks import (
    discriminator_loss,
    generator_loss,
    kl_divergence,
    Recognition,
    sample_latent,
)
from tap_ros.training.devices import Autocast
import torch


@dataclass(frozen=True)
class Networks:
    """
    The networks that take part in training; which ones, the method says.

    :param predictor: G.
    :param recognition: q_phi (Eq. 9), or None.
    :param discriminator: D_t (Eq. 11), which judges predictions from the prior (or without z), or
        None.
    :param posterior_discriminator: D'_t (Eq. 10), which judges those from the posterior, or None.
    """

    predictor: PredictorNetwork
    recognition: Recognition | None = None
    discriminator: torch.nn.Module | None = None
    posterior_discriminator: torch.nn.Module | None = None


@dataclass(frozen=True)
class Draws:
    """
    The random numbers of one training step.

    :param posterior: (B, T, latent_size) normal; one z for each target is used with the posterior
        'frame', else the first.
    :param prior: (B, latent_size) normal.
    :param other: (B, T) in 0..1, to draw t' of Eq. 11.
    """

    posterior: torch.Tensor
    prior: torch.Tensor
    other: torch.Tensor

    @classmethod
    def make(cls, batch: Batch, latent_size: int, seed: int, step: int) -> Self:
        """
        Draw those of a step, on the batch's device, the same ones whenever asked.

        :param batch: batches.Batch.
        :param latent_size: of z.
        :param seed: of the training; step: number of the step.
        :return: Draws.
        """
        rng = np.random.default_rng([seed, 4, step])
        B, T = batch.times.shape
        draws = (rng.standard_normal((B, T, latent_size), np.float32),
                 rng.standard_normal((B, latent_size), np.float32),
                 rng.random((B, T), np.float32))
        return cls(*(torch.from_numpy(draw).to(batch.times.device) for draw in draws))


@dataclass(frozen=True)
class Outcome:
    """
    The loss of a batch and what it came from.

    :param loss: scalar with gradient.
    :param match: int64 (B,), the matched targets as indices into T.
    :param parts: dict of the terms of the loss, scalars without gradient.
    :param judged: what the discriminators learn from, or None (see discriminators_loss).
    :param nats: KL divergence of z, mean over the batch, without gradient; None without z.
    """

    loss: torch.Tensor
    match: torch.Tensor
    parts: dict[str, torch.Tensor]
    judged: dict[str, Any] | None = None
    nats: torch.Tensor | None = None


def predictor_loss(networks: Networks, batch: Batch, augmentation: Augmentation | None,
                   config: ObjectiveSettings, draws: Draws | None = None,
                   autocast: Autocast = contextlib.nullcontext,
                   kl_share: float = 1.0) -> Outcome:
    """
    Compute the predictor's training loss of a batch.

    With E_t = E(x_t, G(c)) and t* chosen by the method (Eqs. 1, 2, 5; summed over levels: 3):

        E_{t*}                                                               no GAN, no VAE
        E_{t*} - log D_{t*}(c, G(c))                                         GAN (Eq. 7)
        D_KL(q(z|X), p(z)) + E_{t*} at z ~ q                                 VAE (Eq. 9)
        the same - log D_{t*}(c, G(c, z ~ p)) - log D'_{t*}(c, G(c, z ~ q))  both (Eq. 10)

    each with its weight. The GAN's terms stand at the matched frame, as in Eq. 10, and are left
    out of the choice.

    :param draws: Draws; needed with GAN or VAE.
    :param autocast: makes the context manager to run the networks in.
    :param kl_share: of the weight of the KL divergence at this step, see training.kl_share.
    :return: Outcome.
    """
    targets = Targets(batch, augmentation, config)
    kl_weight = kl_share * config.kl_weight
    context = to_float(batch.context)  # B, C, 3, H, W
    context = augmentation.apply(context) if augmentation else context
    parts: dict[str, torch.Tensor] = {}
    z = nats = None
    if networks.recognition is not None:
        assert draws is not None, 'z is drawn'
        if config.posterior == 'frame':
            return _frame_posterior_loss(
                networks, targets, context, config, draws, autocast, kl_weight)
        assert batch.video is not None, 'see Sampling.video_frames'
        video = to_float(batch.video)
        with autocast():
            mean, log_variance = networks.recognition(
                augmentation.apply(video) if augmentation else video)
        z = sample_latent(mean, log_variance, draws.posterior[:, 0])
        nats = kl_divergence(mean, log_variance).mean()
        parts['kl'] = kl_weight * (nats - config.free_nats).clamp(min=0)
    with autocast():
        prediction = networks.predictor(context, z)
    measured = targets.measured(context)
    match = targets.match(prediction.image, measured)
    parts['error'] = targets.l1(prediction.image, match).mean()
    judged = None
    if networks.discriminator is not None:
        assert draws is not None, "t' is drawn"
        judged = _judge(networks, prediction, z, targets, context, match, draws, autocast)
        with autocast():
            verdicts = [judge(context, image) for judge, image in judged['pairs']]
        parts['gan'] = config.gan_weight * total(
            generator_loss(logits, judged['step']) for logits in verdicts)
    if config.recursion > 1:
        parts['error'] = _recursive_loss(
            networks, prediction, targets, context, measured, match, parts['error'], config, z,
            autocast)
    return Outcome(total(parts.values()), match,
                   {name: value.detach() for name, value in parts.items()}, judged,
                   None if nats is None else nats.detach())


def _judge(networks: Networks, prediction: Prediction, z: torch.Tensor | None, targets: Targets,
           context: torch.Tensor, match: torch.Tensor, draws: Draws,
           autocast: Autocast) -> dict[str, Any]:
    """Gather what the discriminators see of this batch."""
    batch = targets.batch
    pairs = [(networks.discriminator, targets.visible(prediction.image))]
    if networks.posterior_discriminator is not None:
        with autocast():
            sampled = networks.predictor(context, draws.prior)
        pairs = [(networks.discriminator, targets.visible(sampled.image)),
                 (networks.posterior_discriminator, targets.visible(prediction.image))]
    chance = draws.other.masked_fill(~batch.valid, -1)
    chance[targets.rows, match] = -0.5  # t' is another frame, if there is one
    other = chance.argmax(1)
    return {'pairs': pairs, 'context': context,
            'real': targets.frame(match), 'other': targets.frame(other),
            # The first output is for time 1: context and target are never the same frame.
            'step': batch.times.gather(1, match[:, None])[:, 0] - 1,
            'other_step': batch.times.gather(1, other[:, None])[:, 0] - 1}


def discriminators_loss(judged: dict[str, Any],
                        autocast: Autocast = contextlib.nullcontext) -> torch.Tensor:
    """
    Compute the discriminators' own loss (Eq. 11), for predictions without gradient.

    :param judged: of an Outcome.
    :param autocast: makes the context manager to run the networks in.
    :return: scalar with gradient.
    """
    losses = []
    for judge, image in judged['pairs']:
        with autocast():  # one batch each: batch norm must not mix real and generated frames
            logits = [judge(judged['context'], frame)
                      for frame in (judged['real'], image.detach(), judged['other'])]
        real, generated, other = logits
        losses.append(discriminator_loss(
            real, generated, other, judged['step'], judged['other_step']))
    return total(losses)


def _recursive_loss(networks: Networks, prediction: Prediction, targets: Targets,
                    context: torch.Tensor, measured: torch.Tensor, match: torch.Tensor,
                    loss: torch.Tensor, config: ObjectiveSettings, z: torch.Tensor | None,
                    autocast: Autocast) -> torch.Tensor:
    """
    Add the levels r > 0 of Eq. 3.

    Unlike in the paper, no gradients flow through the predictions as contexts: else the loss of a
    later level bends a picture that serves for itself into one that is easy to go on from.
    """
    batch, valid = targets.batch, targets.batch.valid
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
        with autocast():
            prediction = networks.predictor(context, z)
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


def _frame_posterior_loss(networks: Networks, targets: Targets, context: torch.Tensor,
                          config: ObjectiveSettings, draws: Draws, autocast: Autocast,
                          kl_weight: float) -> Outcome:
    """
    Compute the alternative of appendix B: the minimum over time of the whole CVAE loss.

    L = min_{t in T} [D_KL(q(z | c, x_t), p(z)) + E(x_t, G(c, z ~ q(z | c, x_t)))].

    Recognition network and predictor run once for every target; num_targets keeps that small. With
    genmin the selection error is that of the whole loss instead of the l1 error.
    """
    batch = targets.batch
    B, T = batch.times.shape
    assert networks.recognition is not None
    divergences, errors = [], []
    measured = targets.measured(context)
    for t in range(T):
        step = torch.full_like(targets.rows, t)
        frame = targets.frame(step)
        with autocast():
            mean, log_variance = networks.recognition(torch.cat([context, frame[:, None]], 1))
            prediction = networks.predictor(
                context, sample_latent(mean, log_variance, draws.posterior[:, t]))
        divergences.append(kl_divergence(mean, log_variance))
        errors.append(targets.l1(prediction.image, step))
    divergences, errors = torch.stack(divergences, 1), torch.stack(errors, 1)  # B, T
    whole = (kl_weight * divergences + errors).detach()
    match = match_step(selection_errors(
        whole, lambda: targets.errors(measured), batch, config), batch.valid)
    nats, error = (values.gather(1, match[:, None]).mean()
                   for values in (divergences, errors))
    parts = {'kl': kl_weight * nats, 'error': error}
    return Outcome(total(parts.values()), match,
                   {name: value.detach() for name, value in parts.items()}, nats=nats.detach())
