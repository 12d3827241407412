# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the pictures of a batch come from: files, the memory of a GPU, behind the robot."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import math
import tempfile
from typing import TYPE_CHECKING, Union

import numpy as np
from tap_ros.base.files import storage_errors
from tap_ros.base.progress import Progress
from tap_ros.images.robot_mask import fill_in_time, hidden_pixels, last_free, RobotMask
from tap_ros.recording.cache import cache_folder
import torch

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.recording.episode import Episode

# From (B,) indices of episodes and int (B, N) frame numbers to uint8 (B, N, H, W, 3).
Frames = Callable[[Sequence[int] | np.ndarray, np.ndarray], torch.Tensor]
# From frames (T, H, W, 3), masks (T, H, W) and a RobotMask to filled frames and seen (H, W).
Filling = Callable[[np.ndarray, np.ndarray, RobotMask], tuple[np.ndarray, np.ndarray]]

GOAL = -1  # the "time" of the goal's own picture


def gather(store: 'Episodes', episodes: Sequence[int] | np.ndarray,
           times: np.ndarray) -> torch.Tensor:
    """
    Gather pictures from files.

    :param episodes: (B,) indices of episodes.
    :param times: int (B, N), frame numbers, or GOAL.
    :return: uint8 (B, N, H, W, 3), on the CPU.
    """
    pictures = np.empty((*times.shape, *store.image_size, 3), np.uint8)
    for b, i in enumerate(episodes):
        frames, own = store.frames(i), times[b] == GOAL
        pictures[b, ~own] = frames[times[b, ~own]]
        if own.any():
            pictures[b, own] = store[i].goal_frame
    return torch.from_numpy(pictures)


class ResidentFrames:
    """
    Keep the pictures of all episodes in the memory of a device, where a batch is one gather.

    :param progress: whether to show a progress bar.
    """

    def __init__(self, store: 'Episodes', device: torch.device | str,
                 progress: bool = False) -> None:
        self._first = np.concatenate([[0], np.cumsum(store.lengths)])
        self._goal = np.full(len(store), -1)
        goals = [i for i in range(len(store)) if store[i].goal_frame is not None]
        self._goal[goals] = store.num_frames + np.arange(len(goals))
        size = store.num_frames + len(goals)
        self._frames = torch.empty((size, *store.image_size, 3), dtype=torch.uint8, device=device)
        for i in Progress(range(len(store)), 'frames to the device', disable=not progress):
            frames = torch.from_numpy(np.array(store.frames(i)))
            self._frames[self._first[i]:self._first[i + 1]] = frames
            if self._goal[i] >= 0:
                self._frames[self._goal[i]] = torch.from_numpy(np.array(store[i].goal_frame))

    def __call__(self, episodes: Sequence[int] | np.ndarray, times: np.ndarray) -> torch.Tensor:
        """Gather pictures as the function gather does, on the device."""
        episodes = np.asarray(episodes)[:, None]
        index = np.where(times == GOAL, self._goal[episodes], self._first[episodes] + times)
        return self._frames[torch.from_numpy(index).to(self._frames.device, non_blocking=True)]


def has_room(device: torch.device, *stores: 'Episodes') -> bool:
    """Return whether the pictures of stores take no more than half of a GPU's free memory."""
    pixels = sum((one.num_frames + len(one)) * math.prod(one.image_size) for one in stores)
    return 3 * pixels <= torch.cuda.mem_get_info(device)[0] / 2


class FilledStore:
    """
    An EpisodeStore whose pictures show the scene behind the robot.

    They lie in a file without a name in the folder of the cache, memory-mapped; it vanishes with
    the process. Filling takes some 8 ms for 40 frames of 64x64. Episodes without masks are as
    recorded.

    :param robot_mask: see robot_mask.hidden_pixels.
    :param progress: whether to show a progress bar.
    :param filling: robot_mask.fill_in_time or fill_from_past.
    :ivar gather: Frames of these pictures.
    :ivar seen: bool (E, H, W), False where a pixel of an episode is hidden and nothing fills it;
        there the pictures are as recorded.
    :raises StorageError: when the disk is full.
    """

    def __init__(self, store: 'EpisodeStore', robot_mask: RobotMask,
                 progress: bool = False, filling: Filling = fill_in_time) -> None:
        self._store, self._robot_mask, self._filling = store, robot_mask, filling
        self.gather: Frames = partial(gather, self)
        self.lengths, self.num_frames = store.lengths, store.num_frames
        self.image_size = store.image_size
        self.seen = np.ones((len(store), *store.image_size), bool)
        # Rows of the file: of each episode its frames, then its goal picture.
        self._first = np.concatenate([[0], np.cumsum(store.lengths + 1)])
        folder = cache_folder()
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as file:
                for i in Progress(
                        range(len(store)), 'filling behind the robot', disable=not progress):
                    for pictures in self._fill(i):
                        file.write(np.ascontiguousarray(pictures).data)
                file.flush()
                self._frames = np.memmap(
                    file, np.uint8, 'r', 0, (int(self._first[-1]), *store.image_size, 3))

    def _fill(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the filled frames of an episode and its goal picture, else the last frame."""
        episode = self._store[i]
        frames, goal, mask = episode.frames, episode.goal_frame, episode.goal_mask
        if episode.robot_masks is None:
            return frames, frames[-1] if goal is None else goal
        filled, self.seen[i] = self._filling(frames, episode.robot_masks, self._robot_mask)
        if goal is None or mask is None:
            return filled, filled[-1]
        behind = last_free(frames, episode.robot_masks)
        return filled, np.where(hidden_pixels(mask, self._robot_mask)[..., None], behind, goal)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._store)

    def frames(self, i: int) -> np.ndarray:
        """Return the frames of episode i, (T, H, W, 3) uint8."""
        return self._frames[self._first[i]:self._first[i + 1] - 1]

    def __getitem__(self, i: int) -> 'Episode':
        """
        Return Episode i.

        What the robot hides of its goal picture shows what was seen there free last; if nothing
        tells what that is, the goal picture is the filled last frame.
        """
        episode = self._store[i]
        goal = None if episode.goal_frame is None else self._frames[self._first[i + 1] - 1]
        return replace(episode, frames=self.frames(i), goal_frame=goal)


Episodes = Union['EpisodeStore', FilledStore]
