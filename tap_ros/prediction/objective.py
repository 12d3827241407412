# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the predictor is trained to do: from a batch to its loss."""

import contextlib
from dataclasses import dataclass

from tap_ros.images import to_float
from tap_ros.prediction.discriminator import discriminator_loss, generator_loss
from tap_ros.prediction.losses import (
    bell_preference,
    cost_of_reaching,
    fixed_time_loss,
    l1_error,
    l1_errors,
    linear_preference,
    match_step,
    path_length,
    preferred_error,
    recursive_loss,
    relative_to_copying,
    remaining_targets,
)
from tap_ros.prediction.methods import DEFAULT_BETA
from tap_ros.prediction.networks import Prediction, Predictor
from tap_ros.prediction.recognition import kl_divergence, Recognition, sample_latent
import torch

_POWER_OFFSET = 1e-4  # keeps the slope of a power finite at an error of 0


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

    predictor: Predictor
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
    def make(cls, batch, latent_size, seed, step):
        """Draw those of a step, on the batch's device, the same ones whenever asked."""
        generator = torch.Generator().manual_seed((seed << 32) + step)
        B, T = batch.times.shape
        draws = (torch.randn(B, T, latent_size, generator=generator),
                 torch.randn(B, latent_size, generator=generator),
                 torch.rand(B, T, generator=generator))
        return cls(*(draw.to(batch.times.device) for draw in draws))


@dataclass(frozen=True)
class Outcome:
    """
    The loss of a batch and what it came from.

    :param loss: scalar with gradient.
    :param match: int64 (B,), the matched targets as indices into T.
    :param prediction: Prediction.
    :param parts: dict of the terms of the loss, scalars without gradient.
    :param judged: what the discriminators learn from, or None (see discriminators_loss).
    """

    loss: torch.Tensor
    match: torch.Tensor
    prediction: Prediction
    parts: dict
    judged: dict | None = None


def time_preference(batch, config):
    """
    Compute w(t) for the configured method: linear in forward prediction, else a bell.

    :param batch: batches.Batch.
    :param config: TrainingConfig.
    :return: (B, T).
    """
    if config.forward:
        beta = config.chosen.beta
        return linear_preference(
            batch.times, batch.end, DEFAULT_BETA if beta is None else beta)
    return bell_preference(batch.times, batch.first, batch.last, config.bell_edge)


def selection_errors(error, copy_error, batch, config):
    """
    Compute E'_t of Eq. 5 for the configured method.

    :param error: (B, T), of the prediction against each target.
    :param copy_error: (B, C, T), of the context pictures against each target.
    :param batch: batches.Batch.
    :param config: TrainingConfig.
    :return: (B, T).
    """
    if config.chosen.loss == 'min':
        return error
    preference = time_preference(batch, config)
    if config.chosen.selection == 'relative_to_copying':
        return relative_to_copying(error, copy_error, preference)
    if config.chosen.selection == 'cost_of_reaching':
        cost = path_length(batch.context[:, 0], batch.targets, batch.valid)
        return cost_of_reaching(error, cost, preference)
    return preferred_error(error, preference)


class _Targets:
    """The frames of a batch that predictions are compared with."""

    def __init__(self, batch, augmentation, config):
        self.batch, self.augmentation, self.config = batch, augmentation, config
        self.rows = torch.arange(len(batch.context), device=batch.context.device)

    def frame(self, step):
        """Return the augmented frames (B, 3, H, W) at indices step (B,) into T."""
        frame = to_float(self.batch.targets[self.rows, step])[:, None]
        return (self.augmentation.apply(frame) if self.augmentation else frame)[:, 0]

    def match(self, image, context, valid, selection):
        """
        Find the target that each prediction is trained towards, the argmin of Eq. 5.

        Chosen among the frames as recorded: undoing the augmentation of one picture is cheaper
        than applying it to all targets.
        """
        if self.config.chosen.loss == 'fix':
            return torch.zeros_like(self.rows)  # the batch begins with the fixed frame
        errors = self.errors(torch.cat([image.detach()[:, None], context.detach()], 1))
        selection_error = selection(errors[:, 0], errors[:, 1:], self.batch, self.config)
        return match_step(selection_error, valid)

    def errors(self, images):
        """Return the errors (B, Q, T) of augmented pictures (B, Q, 3, H, W), as recorded."""
        if self.augmentation:
            images = self.augmentation.undo(images)
        return l1_errors(images, self.batch.targets.movedim(-1, 2))

    def loss(self, image, step):
        """Return E_t: the l1 error at step, to the configured power, as a mean."""
        return fixed_time_loss(
            lambda step: _outer(l1_error(image, self.frame(step)), self.config), step)


def _outer(error, config):
    """Raise l1 errors to the configured power."""
    power = config.outer_power
    return error if power == 1 else (error + _POWER_OFFSET) ** power


def predictor_loss(networks, batch, augmentation, config, draws=None,
                   autocast=contextlib.nullcontext, selection=selection_errors):
    """
    Compute the predictor's training loss of a batch (Eq. 1, 2, 3, 5, 7, 9 or 10).

    The GAN's terms stand at the matched frame, as in Eq. 10, and are left out of the choice. With
    an outer power below 1 the outer error is E_t ** power, which is not in the paper. The mean of
    E_t is as low for a blend of two possible bottlenecks as for either of them; a concave function
    of it is lowest at one of them, so that the network commits itself.

    :param networks: Networks.
    :param batch: batches.Batch.
    :param augmentation: Augmentation, or None.
    :param config: TrainingConfig.
    :param draws: Draws; needed with GAN or VAE.
    :param autocast: makes the context manager to run the networks in.
    :param selection: function (error (B, T), copy_error (B, C, T), batch, config) -> E'_t (B, T):
        any preference.
    :return: Outcome.
    """
    targets = _Targets(batch, augmentation, config)
    context = to_float(batch.context)  # B, C, 3, H, W
    context = augmentation.apply(context) if augmentation else context
    if networks.recognition is not None and config.posterior == 'frame':
        return _frame_posterior_loss(
            networks, targets, context, config, draws, autocast, selection)
    parts, z = {}, None
    if networks.recognition is not None:
        video = to_float(batch.video)
        with autocast():
            mean, log_variance = networks.recognition(
                augmentation.apply(video) if augmentation else video)
        z = sample_latent(mean, log_variance, draws.posterior[:, 0])
        parts['kl'] = config.kl_weight * kl_divergence(mean, log_variance).mean()
    with autocast():
        prediction = networks.predictor(context, z)
    match = targets.match(prediction.image, context, batch.valid, selection)
    parts['error'] = targets.loss(prediction.image, match)
    judged = None
    if networks.discriminator is not None:
        judged = _judge(networks, prediction, z, targets, context, match, draws, autocast)
        with autocast():
            verdicts = [judge(context, image) for judge, image in judged['pairs']]
        parts['gan'] = config.gan_weight * sum(
            generator_loss(logits, judged['step']) for logits in verdicts)
    if config.recursion > 1:
        parts['error'] = _recursive_loss(
            networks, prediction, targets, context, match, parts['error'], config, z, autocast,
            selection)
    return Outcome(sum(parts.values()), match, prediction,
                   {name: value.detach() for name, value in parts.items()}, judged)


def _judge(networks, prediction, z, targets, context, match, draws, autocast):
    """Gather what the discriminators see of this batch."""
    batch = targets.batch
    pairs = [(networks.discriminator, prediction.image)]
    if networks.posterior_discriminator is not None:
        with autocast():
            sampled = networks.predictor(context, draws.prior)
        pairs = [(networks.discriminator, sampled.image),
                 (networks.posterior_discriminator, prediction.image)]
    chance = draws.other.masked_fill(~batch.valid, -1)
    chance[targets.rows, match] = -0.5  # t' is another frame, if there is one
    other = chance.argmax(1)
    return {'pairs': pairs, 'context': context,
            'real': targets.frame(match), 'other': targets.frame(other),
            # The first output is for time 1: context and target are never the same frame.
            'step': batch.times.gather(1, match[:, None])[:, 0] - 1,
            'other_step': batch.times.gather(1, other[:, None])[:, 0] - 1}


def discriminators_loss(judged, autocast=contextlib.nullcontext):
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
        losses.append(discriminator_loss(*logits, judged['step'], judged['other_step']))
    return sum(losses)


def _recursive_loss(networks, prediction, targets, context, match, loss, config, z, autocast,
                    selection):
    """Add the levels r > 0 of Eq. 3; gradients flow through the predictions as contexts."""
    batch, valid = targets.batch, targets.batch.valid
    losses, counts = [loss], [len(context)]
    for _ in range(config.recursion - 1):
        matched = batch.times.gather(1, match[:, None])
        valid = remaining_targets(valid, batch.times, matched, config.forward)
        left = valid.any(1)
        if not left.any():
            break
        # The prediction takes the place of the start (forward) or of the goal.
        following = prediction.image[:, None]
        context = following if config.forward else torch.cat([context[:, :1], following], 1)
        with autocast():
            prediction = networks.predictor(context, z)
        match = targets.match(prediction.image, context, valid | ~left[:, None], selection)
        errors = _outer(l1_error(prediction.image, targets.frame(match)), config)
        losses.append(errors[left].mean())
        counts.append(left.sum().item())
    return recursive_loss(losses, counts)


def _frame_posterior_loss(networks, targets, context, config, draws, autocast, selection):
    """
    Compute the alternative of appendix B: the minimum over time of the whole CVAE loss.

    Recognition network and predictor run once for every target; num_targets keeps that small. With
    genmin the selection error is that of the whole loss instead of the l1 error.
    """
    batch = targets.batch
    B, T = batch.times.shape
    divergences, errors, predictions = [], [], []
    for t in range(T):
        step = torch.full_like(targets.rows, t)
        frame = targets.frame(step)
        with autocast():
            mean, log_variance = networks.recognition(torch.cat([context, frame[:, None]], 1))
            prediction = networks.predictor(
                context, sample_latent(mean, log_variance, draws.posterior[:, t]))
        divergences.append(config.kl_weight * kl_divergence(mean, log_variance))
        errors.append(l1_error(prediction.image, frame))
        predictions.append(prediction)
    divergences, errors = torch.stack(divergences, 1), torch.stack(errors, 1)  # B, T
    whole, copying = (divergences + errors).detach(), targets.errors(context)
    match = match_step(selection(whole, copying, batch, config), batch.valid)
    parts = {'kl': fixed_time_loss(divergences, match),
             'error': fixed_time_loss(_outer(errors, config), match)}
    return Outcome(sum(parts.values()), match, _choose(predictions, match),
                   {name: value.detach() for name, value in parts.items()})


def _choose(predictions, match):
    """Put together, for each episode, the prediction of its matched target."""
    def pick(name):
        values = [getattr(prediction, name) for prediction in predictions]
        return None if values[0] is None else torch.stack(values, 1)[
            torch.arange(len(match), device=match.device), match]
    return Prediction(*(pick(name) for name in ('image', 'flow', 'masks', 'new_pixels')))


@torch.no_grad()
def matched(network, batch, config, autocast=contextlib.nullcontext):
    """
    Predict, with z at 0, and find the frames that the method chooses.

    :param network: Predictor in eval mode.
    :param batch: batches.Batch, on the network's device.
    :param config: TrainingConfig.
    :param autocast: makes the context manager to run the network in.
    :return: (Prediction, int64 (B,) indices into T).
    """
    context = to_float(batch.context)
    with autocast():
        prediction = network(context)
    targets = _Targets(batch, None, config)
    return prediction, targets.match(prediction.image, context, batch.valid, selection_errors)


@torch.no_grad()
def held_out_scores(network, batches, config, autocast=contextlib.nullcontext):
    """
    Measure a network by the error at the frames that its method chooses; z is 0.

    :param network: Predictor in eval mode.
    :param batches: iterable of batches.Batch, on the network's device.
    :param config: TrainingConfig.
    :param autocast: makes the context manager to run the network in.
    :return: dict of loss (the l1 error), match_fraction and match_fraction_std.
    """
    losses, fractions = [], []
    for batch in batches:
        prediction, match = matched(network, batch, config, autocast)
        rows = torch.arange(len(match), device=match.device)
        losses.append(l1_error(prediction.image, to_float(batch.targets[rows, match])).cpu())
        fractions.append((batch.times.gather(1, match[:, None]) / batch.end)[:, 0].cpu())
    fractions = torch.cat(fractions)
    return {'loss': torch.cat(losses).mean().item(),
            'match_fraction': fractions.mean().item(),
            'match_fraction_std': fractions.std(correction=0).item()}
