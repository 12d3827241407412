# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings without the robot: every episode filled once, then read like the recordings."""

from collections.abc import Callable
from dataclasses import dataclass, replace
import tempfile
from typing import TYPE_CHECKING, Union
import warnings

import numpy as np
from tap_ros.base.errors import RecordingError
from tap_ros.base.files import storage_errors
from tap_ros.images.robot_mask import fill_in_time, hidden_pixels, last_free, RobotMask
from tap_ros.messages.topics import ROBOT_MASK
from tap_ros.recording.cache import cache_folder
from tap_ros.recording.episode import RecordingWarning
from tap_ros.training.frames import Frames, MappedFrames
from tqdm import tqdm

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.recording.episode import Episode

# From frames (T, H, W, 3), masks (T, H, W) and a RobotMask to filled frames and seen (H, W).
Filling = Callable[[np.ndarray, np.ndarray, RobotMask], tuple[np.ndarray, np.ndarray]]


class FilledStore:
    """
    An EpisodeStore whose pictures show the scene behind the robot.

    They lie in a file without a name in the folder of the cache, memory-mapped; it vanishes with
    the process. Filling takes some 8 ms for 40 frames of 64x64. Episodes without masks are as
    recorded.

    :param robot_mask: see robot_mask.hidden_pixels.
    :param progress: whether to show a progress bar.
    :param filling: robot_mask.fill_in_time or fill_from_past.
    :ivar seen: bool (E, H, W), False where a pixel of an episode is hidden and nothing fills it;
        there the pictures are as recorded.
    :raises StorageError: when the disk is full.
    """

    def __init__(self, store: 'EpisodeStore', robot_mask: RobotMask,
                 progress: bool = False, filling: Filling = fill_in_time) -> None:
        self._store, self._robot_mask, self._filling = store, robot_mask, filling
        self.lengths, self.num_frames = store.lengths, store.num_frames
        self.image_size = store.image_size
        self.seen = np.ones((len(store), *store.image_size), bool)
        # Rows of the file: of each episode its frames, then its goal picture.
        self._first = np.concatenate([[0], np.cumsum(store.lengths + 1)])
        folder = cache_folder()
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as file:
                for i in tqdm(range(len(store)), 'filling behind the robot', disable=not progress):
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


@dataclass(frozen=True)
class Filled:
    """
    Pictures of the scene behind the robot.

    :param frames: as Frames of the recordings.
    :param seen: bool (E, H, W), False where a pixel of an episode is hidden and never free.
    """

    frames: Frames
    seen: np.ndarray


def fill(store: 'EpisodeStore', robot_mask: RobotMask,
         make_frames: Callable[..., Frames] = MappedFrames,
         progress: bool = False) -> Filled | None:
    """
    Fill the episodes of recordings.

    :param robot_mask: see robot_mask.hidden_pixels.
    :param make_frames: takes a store and makes the Frames of it.
    :param progress: whether to show a progress bar.
    :return: Filled; None for 'none'.
    """
    if robot_mask == 'none':
        return None
    filled = FilledStore(store, robot_mask, progress)
    return Filled(make_frames(filled), filled.seen)


def with_masks(store: 'EpisodeStore', parts: tuple[np.ndarray, np.ndarray],
               robot_mask: RobotMask) -> tuple[np.ndarray, np.ndarray]:
    """
    Leave out the episodes that a robot mask cannot be used with.

    :param parts: int64, indices of the episodes to train on and of those held out.
    :param robot_mask: see robot_mask.hidden_pixels; with 'none' all of them stay.
    :return: the same, with those whose frames all have a mask; a warning says how many have not.
    :raises RecordingError: when none is left to train on.
    """
    if robot_mask == 'none':
        return parts
    training, held_out = (part[[store.has_masks(int(i)) for i in part]] for part in parts)
    before, after = sum(map(len, parts)), len(training) + len(held_out)
    if len(parts[0]) and not len(training):
        raise RecordingError(
            f'recordings: robot_mask {robot_mask} needs a robot mask for every picture of an '
            f'episode, and {len(training)} of {len(parts[0])} to train on have them; record '
            f'{ROBOT_MASK.recorded} beside the camera, or give --robot-mask none')
    if after < before:
        warnings.warn(
            f'recordings: {before - after} of {before} episodes are left out, as not all of their '
            'pictures have a robot mask', RecordingWarning, stacklevel=3)
    return training, held_out
