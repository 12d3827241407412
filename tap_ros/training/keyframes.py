# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The third picture of a training: labelled frames of the demonstrations that are most alike."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ImageError
from tap_ros.prediction.keyframe_bank import KeyframeBank
from tap_ros.prediction.retrieval import ends_of, neighbours
from tap_ros.recording.full_size import FullSize
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.training.predictor_config import TrainingConfig

NEIGHBOURS = 5  # demonstrations of which one is drawn, so that its picture must be moved


class Keyframes:
    """
    The labelled frame of each training episode.

    :param store: the EpisodeStore; episodes: indices of those to train on.
    :param preference: of each episode of the store w (levels, T); its largest is the label.
    """

    def __init__(self, store: 'EpisodeStore', episodes: np.ndarray,
                 preference: Sequence[np.ndarray]) -> None:
        self._store, self._episodes = store, episodes
        self._labels = [int(preference[i][0].argmax()) for i in episodes.tolist()]
        self._ends = np.stack([ends_of(*store.frames(i)[[0, -1]]) for i in episodes.tolist()])
        self._near = (neighbours(self._ends, NEIGHBOURS)[0] if len(episodes) > 1
                      else np.zeros((1, 1), np.int64))
        self._pictures = torch.from_numpy(np.stack([
            store.frames(i)[t] for i, t in zip(episodes.tolist(), self._labels)]))

    def draw(self, chosen: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
        """Return uint8 (B, 1, H, W, 3), for each episode that of one of the most alike others."""
        near = self._near[np.searchsorted(self._episodes, chosen)]
        return self._pictures[near[np.arange(len(near)), rng.integers(near.shape[1], size=len(
            near))]][:, None]

    def bank(self, config: 'TrainingConfig') -> KeyframeBank:
        """Return the bank that goes with the weights, of pictures at the recorded size."""
        full = FullSize(self._store, config.crop)

        def shown(n: int) -> np.ndarray:
            return full.picture(int(self._episodes[n]), self._labels[n])

        try:
            return KeyframeBank.choose(self._ends, shown)
        except ImageError:  # some cannot be read one by one, or cameras differ
            return KeyframeBank.choose(self._ends, lambda n: self._pictures[n].numpy())
