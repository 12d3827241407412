# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips for people: what is predicted, which real frame it matches, and whether that is hit."""

from collections.abc import Sequence

import cv2
import numpy as np
from tap_ros.evaluation.bottleneck import context_pixels
from tap_ros.evaluation.hits import is_hit
from tap_ros.evaluation.prediction import all_targets, ask
from tap_ros.images.drawing import enlarge, GAP, grid, overlay
from tap_ros.images.pixels import resize_image, to_uint8
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.protocol import Predictor
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.marks import Marks
from tap_ros.training.frames import FilledStore
import torch

_SIDE, _MOST = 128, 256  # least and most pixels a side of a picture in a strip
_LINE = 18  # pixels between lines of text


def draw_strips(network: PredictorNetwork | Predictor, store: EpisodeStore,
                episodes: Sequence[int] | np.ndarray, goal_picture: str = 'last',
                filled: FilledStore | None = None, marks: Marks | None = None,
                large: Sequence[Sequence[np.ndarray]] = ()) -> np.ndarray:
    """
    Draw a sheet of strips, a row for each episode.

    Columns: its number, which frame is matched and whether that is a marked one; start,
    prediction, matched frame, goal if one is given; and the prediction with its object maps where
    the objects are known and no pixel is new.

    :param network: PredictorNetwork, or another Predictor.
    :param filled: the recordings without the robot, for targets; None: as they are.
    :param goal_picture: see batches.make_batch.
    :param large: of each episode the pictures to draw instead, in that order, of any size.
    :return: uint8 (height, width, 3).
    """
    batch = all_targets(network, store, episodes, goal_picture, filled)
    with torch.inference_mode():
        image, maps_of = ask(network, batch, episodes)
        visible = batch.visible(image[:, None].cpu())
        errors = l1_errors(visible, batch.targets.movedim(-1, 2))[:, 0]
    match, images = match_step(errors, batch.valid), to_uint8(image.cpu())
    paints = isinstance(network, PredictorNetwork) and network.config.new_pixels
    scale, titles = -(-_SIDE // images.shape[1]), ['', 'start', 'prediction', 'matched frame']
    titles += ['goal'] * (batch.context.shape[1] - 1)
    if large:
        recorded = large[0][0].shape[:2]
        size = tuple(round(side * min(1, _MOST / max(recorded))) for side in recorded)
    rows = []
    for b, i in enumerate(map(int, episodes)):
        at, last = int(batch.times[b, match[b]]), int(batch.end[b])
        window = marks.episodes.get(i, ()) if marks else ()
        start, *goal = batch.context[b].numpy()
        panels = list(large[b]) if large else [
            start, images[b], batch.targets[b, match[b]].numpy(), *goal]
        pixels = context_pixels(store[i], goal_picture)
        if pixels.size and np.isfinite(pixels).all() and not paints:
            panels.append(overlay(images[b], maps_of(b, pixels).maps.cpu().numpy()))
        panels = [resize_image(panel, size) if large else enlarge(panel, scale)
                  for panel in panels]
        hit = ['hit' if is_hit(window, at) else 'next to it' if is_hit(window, at, 1) else 'miss']
        said = write_lines([f'episode {i}', f'{at} of {last}', *hit * bool(window)],
                           panels[0].shape[:2])
        rows.append([said, *panels])
    titles += ['object maps'] * (max(map(len, rows)) - len(titles))
    head = grid([[write_lines([title], (_LINE, rows[0][0].shape[1])) for title in titles]])
    return np.concatenate([head, np.full((GAP, head.shape[1], 3), 255, np.uint8), grid(rows)])


def write_lines(lines: Sequence[str], size: tuple[int, int]) -> np.ndarray:
    """Write lines of text into a white picture of a size (H, W)."""
    canvas = np.full((*size, 3), 255, np.uint8)
    for number, line in enumerate(lines, start=1):
        cv2.putText(canvas, line, (2, number * _LINE - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4,
                    (0, 0, 0), 1, cv2.LINE_AA)
    return canvas
