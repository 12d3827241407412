# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the network does with a batch, as a picture for people."""

import numpy as np
from tap_ros.images.drawing import grid
from tap_ros.images.pixels import to_uint8
from tap_ros.prediction.batches import Batch
from tap_ros.prediction.networks import Prediction
from tap_ros.training.panels import grey_panels
import torch


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
