# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of predictions for people: rows of panels side by side."""

import numpy as np
from tap_ros.images import to_uint8
import torch

_GAP = 2
# One colour for each object, bright on the table's grey.
OBJECT_COLOURS = ((255, 40, 40), (40, 90, 255), (30, 200, 60), (230, 180, 20))


def grid(rows, scale=1):
    """
    Put panels of one size side by side, and rows below each other.

    :param rows: list of lists of uint8 (H, W, 3).
    :param scale: whole number of times to enlarge each pixel.
    :return: uint8 (height, width, 3), white between the panels.
    """
    rows = [[panel.repeat(scale, 0).repeat(scale, 1) for panel in row] for row in rows]
    H, W, _ = rows[0][0].shape
    columns = max(len(row) for row in rows)
    sheet = np.full((len(rows) * (H + _GAP) - _GAP, columns * (W + _GAP) - _GAP, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, panel in enumerate(row):
            sheet[i * (H + _GAP):i * (H + _GAP) + H, j * (W + _GAP):j * (W + _GAP) + W] = panel
    return sheet


def grey_panels(maps):
    """
    Show numbers from 0 to 1 as grey.

    :param maps: tensor (N, H, W).
    :return: list of N uint8 (H, W, 3).
    """
    return list(to_uint8(maps[:, None].expand(-1, 3, -1, -1) * 2 - 1))


def overlay(image, object_maps):
    """
    Tint a picture where objects are expected.

    :param image: uint8 (H, W, 3).
    :param object_maps: (K, H, W), each sums to 1.
    :return: uint8 (H, W, 3).
    """
    tinted = image.astype(np.float32)
    for k, probability in enumerate(object_maps):
        # The square root makes spread-out maps visible beside sharp ones.
        strength = np.sqrt(probability / max(probability.max(), 1e-12))[..., None] * 0.85
        tinted += strength * (np.float32(OBJECT_COLOURS[k % len(OBJECT_COLOURS)]) - tinted)
    return np.rint(tinted).astype(np.uint8)


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
