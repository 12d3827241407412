# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the predictor is trained to do: from a batch to its loss."""

import contextlib
from dataclasses import dataclass, replace

from tap_ros.images import to_float
from tap_ros.prediction.losses import (
    bell_preference,
    fixed_time_loss,
    generalized_minimum_loss,
    l1_error,
    l1_errors,
    match_step,
    preferred_error,
    relative_to_copying,
)
from tap_ros.prediction.networks import Prediction
import torch

_POWER_OFFSET = 1e-4  # keeps the slope of a power finite at an error of 0


@dataclass(frozen=True)
class Outcome:
    """
    The loss of a batch and what it came from.

    :param loss: scalar with gradient.
    :param match: int64 (B,), the matched targets as indices into T.
    :param prediction: Prediction.
    """

    loss: torch.Tensor
    match: torch.Tensor
    prediction: Prediction


def selection_errors(error, copy_error, batch, config):
    """
    Compute E'_t of Eq. 5 for the configured method.

    :param error: (B, T), of the prediction against each target.
    :param copy_error: (B, C, T), of the context pictures against each target.
    :param batch: batches.Batch.
    :param config: TrainingConfig.
    :return: (B, T).
    """
    if config.method == 'min':
        return error
    preference = bell_preference(batch.times, batch.first, batch.last, config.bell_edge)
    if config.selection == 'time_preference':
        return preferred_error(error, preference)
    return relative_to_copying(error, copy_error, preference)


def predictor_loss(network, batch, augmentation, config, autocast=contextlib.nullcontext):
    """
    Compute the training loss of a batch (Eq. 1, 2 or 5).

    With an outer power below 1 the outer error is E_t ** power, which is not in the paper. The
    mean of E_t is as low for a blend of two possible bottlenecks as for either of them; a concave
    function of it is lowest at one of them, so that the network commits itself.

    :param network: Predictor.
    :param batch: batches.Batch.
    :param augmentation: Augmentation, or None.
    :param config: TrainingConfig.
    :param autocast: makes the context manager to run the network in.
    :return: Outcome.
    """
    rows = torch.arange(len(batch.context), device=batch.context.device)
    recorded = to_float(batch.context)  # B, C, 3, H, W
    context = augmentation.apply(recorded) if augmentation else recorded
    with autocast():
        prediction = network(context)

    def error(step):
        target = to_float(batch.targets[rows, step])[:, None]  # B, 1, 3, H, W
        target = augmentation.apply(target) if augmentation else target
        value = l1_error(prediction.image, target[:, 0])
        power = config.outer_power
        return value if power == 1 else (value + _POWER_OFFSET) ** power

    if config.method == 'fix':
        step = torch.zeros_like(rows)  # the batch holds the middle frame only
        return Outcome(fixed_time_loss(error, step), step, prediction)
    # Choose among the frames as recorded: undoing the augmentation of one picture is cheaper
    # than applying it to all targets.
    image = prediction.image.detach()[:, None]
    image = augmentation.undo(image) if augmentation else image
    errors = l1_errors(torch.cat([image, recorded], 1), batch.targets.movedim(-1, 2))
    selection_error = selection_errors(errors[:, 0], errors[:, 1:], batch, config)
    loss = generalized_minimum_loss(error, selection_error, batch.valid)
    return Outcome(loss, match_step(selection_error, batch.valid), prediction)


@torch.no_grad()
def held_out_scores(network, batches, config, autocast=contextlib.nullcontext):
    """
    Measure a network by the objective it is trained on.

    :param network: Predictor in eval mode.
    :param batches: iterable of batches.Batch, on the network's device.
    :param config: TrainingConfig.
    :param autocast: makes the context manager to run the network in.
    :return: dict of loss, match_fraction and match_fraction_std.
    """
    losses, fractions = [], []
    for batch in batches:
        outcome = predictor_loss(network, batch, None, replace(config, outer_power=1.0), autocast)
        losses += [outcome.loss.item()] * len(batch.context)
        matched = batch.times.gather(1, outcome.match[:, None])
        fractions.append((matched / batch.end)[:, 0].cpu())
    fractions = torch.cat(fractions)
    return {'loss': sum(losses) / len(losses),
            'match_fraction': fractions.mean().item(),
            'match_fraction_std': fractions.std(correction=0).item()}
