# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures beside start and goal: labelled frames of the demonstrations that are most alike."""

from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ImageError
from tap_ros.prediction.keyframe_bank import KeyframeBank, MOST_OBJECTS
from tap_ros.prediction.retrieval import (
    ends_of,
    inlier_keyframes,
    learned_weights,
    nearest,
    pad_columns,
)
from tap_ros.recording.full_size import FullSize
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.training.frames import FilledStore
    from tap_ros.training.predictor_config import TrainingConfig

NUM_KEYFRAMES = 3  # that a network sees, of as many demonstrations
NEIGHBOURS = 5  # demonstrations of which these are drawn, others in each step


class Keyframes:
    """
    The labelled frames of each training episode, but for those that are unlike the others.

    :param store: the EpisodeStore; episodes: indices of those to train on.
    :param preference: of each episode of the store w (levels, T); the largest ones are the labels.
    :param config: of the training.
    :param filled: the store without the robot: keyframes are as targets are.
    :ivar left_out: list of int, the episodes whose keyframes are left out.
    """

    def __init__(self, store: 'EpisodeStore', episodes: np.ndarray,
                 preference: Sequence[np.ndarray], config: 'TrainingConfig',
                 filled: 'FilledStore | None' = None) -> None:
        self._store, self._episodes, self._config, self._filled = store, episodes, config, filled
        rows = episodes.tolist()
        labels = np.stack([preference[i].argmax(1) for i in rows])  # N, levels
        given = store if filled is None or not config.fill_context else filled
        ends = np.stack([ends_of(*given.frames(i)[[0, -1]]) for i in rows])
        shown = store if filled is None else filled
        pictures = np.stack([shown.frames(i)[at] for i, at in zip(rows, labels)])
        self._weights = learned_weights(ends, pictures)
        kept = inlier_keyframes(ends, pictures, self._weights)
        self.left_out = episodes[~kept].tolist()
        self._kept, self._labels, self._ends = episodes[kept], labels[kept], ends[kept]
        if self.left_out:
            pictures = pictures[kept]
            self._weights = learned_weights(self._ends, pictures)
        self._pictures = torch.from_numpy(pictures)
        near, _ = nearest(ends, self._ends, NEIGHBOURS + 1, weights=self._weights)
        own = np.where(kept, kept.cumsum() - 1, -1)[:, None]  # goes last, and is cut off
        others = (near == own).argsort(1, kind='stable')[:, :max(1, near.shape[1] - 1)]
        self._near = np.take_along_axis(near, others, 1)

    def draw(self, chosen: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
        """Return uint8 (B, levels, NUM_KEYFRAMES, H, W, 3) of some, the most alike first."""
        near = self._near[np.searchsorted(self._episodes, chosen)]
        drawn = np.sort(rng.random(near.shape).argsort(1)[:, :NUM_KEYFRAMES], 1)
        return self._pictures[pad_columns(
            np.take_along_axis(near, drawn, 1), NUM_KEYFRAMES)].transpose(1, 2)

    def bank(self) -> KeyframeBank:
        """Return the bank that goes with the weights, of pictures at the recorded size."""
        levels, small = self._labels.shape[1], self._pictures.flatten(0, 1)
        full = FullSize(self._store, self._config.crop)

        def shown(n: int) -> np.ndarray:
            return full.picture(int(self._kept[n // levels]), int(self._labels.flat[n]))

        choose = partial(KeyframeBank.choose, self._ends, objects=self._objects(), levels=levels,
                         weights=self._weights)
        if self._filled is None:
            with suppress(ImageError):  # some cannot be read one by one, or cameras differ
                return choose(shown)
        return choose(lambda n: small[n].numpy())

    def _objects(self) -> np.ndarray | None:
        """Return where objects are, as KeyframeBank takes it."""
        places = [self._store[i].object_pixels[[0, *at]][:, :MOST_OBJECTS]
                  for i, at in zip(self._kept.tolist(), self._labels)]
        objects = np.full((len(places), len(places[0]), max(one.shape[1] for one in places), 2),
                          np.nan, np.float32)
        for row, one in zip(objects, places):
            row[:, :one.shape[1]] = one
        return objects if np.isfinite(objects).any() else None
