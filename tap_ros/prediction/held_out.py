# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a network scores by its own method while it is trained, and how that looks."""

from collections.abc import Iterable
import contextlib

import numpy as np
from tap_ros.images.drawing import grey_panels, grid
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.prediction.batches import Batch
from tap_ros.prediction.losses import l1_error
from tap_ros.prediction.networks import Prediction, PredictorNetwork
from tap_ros.prediction.selection import Targets
from tap_ros.prediction.training_config import TrainingConfig
from tap_ros.training.devices import Autocast
import torch


@torch.no_grad()
def matched(network: PredictorNetwork, batch: Batch, config: TrainingConfig,
            autocast: Autocast = contextlib.nullcontext) -> tuple[Prediction, torch.Tensor]:
    """
    Predict, with z at 0, and find the frames that the method chooses.

    :param network: PredictorNetwork in eval mode.
    :param batch: batches.Batch, on the network's device.
    :param config: TrainingConfig.
    :param autocast: makes the context manager to run the network in.
    :return: (Prediction, int64 (B,) indices into T).
    """
    context = to_float(batch.context)
    with autocast():
        prediction = network(context)
    targets = Targets(batch, None, config)
    return prediction, targets.match(prediction.image, targets.measured(context))


@torch.no_grad()
def held_out_scores(network: PredictorNetwork, batches: Iterable[Batch], config: TrainingConfig,
                    autocast: Autocast = contextlib.nullcontext) -> dict[str, float]:
    """
    Measure a network by the error at the frames that its method chooses; z is 0.

    :param network: PredictorNetwork in eval mode.
    :param batches: iterable of batches.Batch, on the network's device.
    :param config: TrainingConfig.
    :param autocast: makes the context manager to run the network in.
    :return: dict of loss (the l1 error), match_fraction and match_fraction_std.
    """
    losses, fractions = [], []
    for batch in batches:
        prediction, match = matched(network, batch, config, autocast)
        rows = torch.arange(len(match), device=match.device)
        image = batch.visible(prediction.image[:, None])[:, 0]
        losses.append(l1_error(image, to_float(batch.targets[rows, match])).cpu())
        fractions.append((batch.times.gather(1, match[:, None]) / batch.end)[:, 0].cpu())
    fractions = torch.cat(fractions)
    return {'loss': torch.cat(losses).mean().item(),
            'match_fraction': fractions.mean().item(),
            'match_fraction_std': fractions.std(correction=0).item()}


@torch.no_grad()
def sample_grid(batch: Batch, prediction: Prediction, match: torch.Tensor) -> np.ndarray:
    """
    Show a batch: context, prediction, matched frame, one mask for each source, new pixels.

    :param batch: batches.Batch.
    :param prediction: networks.Prediction of it.
    :param match: int64 (B,), the matched targets as indices into T.
    :return: uint8 (height, width, 3).
    """
    context = batch.context.cpu().numpy()
    images = to_uint8(prediction.image)
    match = match.cpu()
    rows = []
    for b in range(len(context)):
        row = [*context[b], images[b], batch.targets[b, match[b]].cpu().numpy()]
        row += grey_panels(prediction.masks[b, :, 0].float())
        if prediction.new_pixels is not None:
            row.append(to_uint8(prediction.new_pixels[b]))
        rows.append(row)
    return grid(rows)
