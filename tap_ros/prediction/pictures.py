# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the network does with a batch, as a picture for people."""

from tap_ros.images import to_uint8
from tap_ros.pictures import grid
import torch


def grey_panels(maps):
    """
    Show numbers from 0 to 1 as grey.

    :param maps: tensor (N, H, W).
    :return: list of N uint8 (H, W, 3).
    """
    return list(to_uint8(maps[:, None].expand(-1, 3, -1, -1) * 2 - 1))


@torch.no_grad()
def sample_grid(batch, outcome):
    """
    Show a batch: start, goal, prediction, matched frame, one mask for each source, new pixels.

    :param batch: batches.Batch.
    :param outcome: objective.Outcome of it.
    :return: uint8 (height, width, 3).
    """
    context = batch.context.cpu().numpy()
    images = to_uint8(outcome.prediction.image)
    match = outcome.match.cpu()
    rows = []
    for b in range(len(context)):
        row = [context[b, 0], context[b, -1], images[b], batch.targets[b, match[b]].cpu().numpy()]
        row += grey_panels(outcome.prediction.masks[b, :, 0].float())
        if outcome.prediction.new_pixels is not None:
            row.append(to_uint8(outcome.prediction.new_pixels[b]))
        rows.append(row)
    return grid(rows)
