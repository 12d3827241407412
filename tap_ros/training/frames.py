# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the pictures of a batch come from: files that are mapped, or the memory of a GPU."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

# From (B,) indices of episodes and int (B, N) frame numbers to uint8 (B, N, H, W, 3).
Frames = Callable[[Sequence[int] | np.ndarray, np.ndarray], torch.Tensor]

GOAL = -1  # the "time" of the goal's own picture


class MappedFrames:
    """Take pictures from the files of the cache."""

    def __init__(self, store: 'EpisodeStore') -> None:
        self._store = store

    def __call__(self, episodes: Sequence[int] | np.ndarray, times: np.ndarray) -> torch.Tensor:
        """
        Gather pictures.

        :param episodes: (B,) indices of episodes.
        :param times: int (B, N), frame numbers, or GOAL.
        :return: uint8 (B, N, H, W, 3), on the CPU.
        """
        pictures = np.empty((*times.shape, *self._store.image_size, 3), np.uint8)
        for b, i in enumerate(episodes):
            frames, own = self._store.frames(i), times[b] == GOAL
            pictures[b, ~own] = frames[times[b, ~own]]
            if own.any():
                pictures[b, own] = self._store[i].goal_frame
        return torch.from_numpy(pictures)


class ResidentFrames:
    """
    Keep the pictures of all episodes in the memory of a device, where a batch is one gather.

    :param progress: whether to show a progress bar.
    """

    def __init__(self, store: 'EpisodeStore', device: torch.device | str,
                 progress: bool = False) -> None:
        self._first = np.concatenate([[0], np.cumsum(store.lengths)])
        self._goal = np.full(len(store), -1)
        goals = [i for i in range(len(store)) if store[i].goal_frame is not None]
        self._goal[goals] = store.num_frames + np.arange(len(goals))
        size = store.num_frames + len(goals)
        self._frames = torch.empty((size, *store.image_size, 3), dtype=torch.uint8, device=device)
        for i in tqdm(range(len(store)), 'frames to the device', disable=not progress):
            frames = torch.from_numpy(np.array(store.frames(i)))
            self._frames[self._first[i]:self._first[i + 1]] = frames
            if self._goal[i] >= 0:
                self._frames[self._goal[i]] = torch.from_numpy(np.array(store[i].goal_frame))

    def __call__(self, episodes: Sequence[int] | np.ndarray, times: np.ndarray) -> torch.Tensor:
        """Gather pictures as MappedFrames does, on the device."""
        episodes = np.asarray(episodes)[:, None]
        index = np.where(times == GOAL, self._goal[episodes], self._first[episodes] + times)
        return self._frames[torch.from_numpy(index).to(self._frames.device, non_blocking=True)]
