# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Predictions at the size of the recorded pictures, against the frames as they were recorded."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from tap_ros.prediction.fullsize import pictures_of
from tap_ros.prediction.protocol import Predictor, Request
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.full_size import FullSize


class Answer(NamedTuple):
    """
    What is shown of an episode, uint8 (H, W, 3) each, and how far off it is, on [0, 1].

    :param pictures: start, prediction, the matched frame, and the goal if one was given.
    :param l1: error of the prediction; copying: of the nearer input.
    """

    pictures: list[np.ndarray]
    l1: float
    copying: float


def answer_at_full_size(predictor: Predictor, store: EpisodeStore,
                        episodes: Sequence[int] | np.ndarray, matched: Sequence[int] | np.ndarray,
                        part: str = '') -> list[Answer]:
    """
    Ask a predictor about recorded pictures that are larger than it needs.

    :param episodes: N indices, at least one; the goal is the last frame of each.
    :param matched: (N,) the frame of each that its prediction is compared with.
    :param part: of the pictures that is used, as Crop takes it.
    :return: N Answers; none where pictures are not larger, or the predictor takes no larger ones.
    """
    full, answers = FullSize(store, part), []
    size = full.picture(int(episodes[0]), 0).shape[:2]
    if size == predictor.image_size or not (
            predictor.full_size and predictor.camera_crop.is_cut(size)):
        return []
    for i, t in zip(map(int, episodes), map(int, matched)):
        start, truth, goal = (full.picture(i, at) for at in (0, t, len(store.frames(i)) - 1))
        request = Request(start, None if predictor.mode == 'forward' else goal)
        inputs = pictures_of(request)
        image = predictor.predict_together([request])[0][0].image
        answers.append(Answer(
            [start, image, truth, *inputs[1:]], _l1(image, truth),
            min(_l1(one, truth) for one in inputs)))
    return answers


def _l1(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.abs(image.astype(np.int16) - truth).mean() / 255)
