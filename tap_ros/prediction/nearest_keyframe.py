# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A baseline without a network: the keyframe of the recorded episode most like the task."""

from collections.abc import Iterable, Sequence
import os
from typing import Any, Self

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.images.crop import trained_crop
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.protocol import check_request, Predictor, Request
from tap_ros.prediction.warp import one_hot_maps
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
import torch


class NearestKeyframe(Predictor):
    """
    Show the keyframe of the recorded episode whose first and last pictures are nearest.

    The keyframe is the frame half way from the first picture to the last, by what they show; with
    recursion, of the way to the keyframe before. It is as it was recorded, so that objects are
    where they were then, not where the request has them.

    :param episodes: with at least two frames each, of one picture size.
    :raises ConfigError: if there is none.
    """

    mode = 'bidirectional'

    def __init__(self, episodes: Iterable[Episode]) -> None:
        self._episodes = [episode for episode in episodes if len(episode) > 1]
        if not self._episodes:
            raise ConfigError('nearest_keyframe: no recorded episode has two frames')
        self._ends = np.stack([episode.frames[[0, -1]] for episode in self._episodes])
        self.image_size = self._ends.shape[2:4]
        self.training: dict[str, Any] = {}
        self.camera_crop = trained_crop(self.training, self.image_size)

    @classmethod
    def load(cls, argument: str, device: Any = 'cpu') -> Self:
        """
        Read recordings.

        :param argument: paths, separated by ':' as in PATH.
        :param device: unused.
        :raises ConfigError: if no path is given; RecordingError: if they cannot be read.
        """
        paths = list(filter(None, argument.split(os.pathsep)))
        if not paths:
            raise ConfigError('nearest_keyframe: name its recordings, such as '
                              'nearest_keyframe:bags/push2')
        store = open_recordings(paths, progress=False)
        return cls(store[i] for i in range(len(store)))

    def predict_together(self, requests: Sequence[Request]) -> list[list[Subgoal]]:
        """Answer requests, see Predictor; each gets one sample."""
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> list[Subgoal]:
        """Return the keyframes for one request, the earliest first."""
        pictures, pixels = check_request(request, self.mode, self.image_size)
        distances = [l1_distance(ends, pictures) for ends in self._ends]  # of start and goal
        episode = self._episodes[int(np.argmin(distances))]
        found, last = [], len(episode) - 1
        for level in range(1, request.recursion_depth + 1):
            last = halfway(episode.frames, last)
            places = recorded_places(episode, last, pixels[0])
            maps = one_hot_maps(torch.from_numpy(places), self.image_size).numpy()
            found.append(Subgoal(np.array(episode.frames[last]), maps, places,
                                 np.ones(len(places), np.float32), sample=0, level=level))
        return found[::-1]


def l1_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean absolute difference of uint8 pictures, 0 to 255."""
    return float(np.abs(one.astype(np.int16) - other).mean())


def halfway(frames: np.ndarray, last: int) -> int:
    """
    Return the frame whose distances to the first one and to the last one differ least.

    :param frames: uint8 (T, H, W, 3).
    :param last: index of the last one.
    :return: 1 .. last - 1; last where there is none between.
    """
    between = range(1, last)
    return min(between, default=last, key=lambda t: abs(
        l1_distance(frames[t], frames[0]) - l1_distance(frames[t], frames[last])))


def recorded_places(episode: Episode, t: int, start_pixels: np.ndarray) -> np.ndarray:
    """
    Return where the objects of a request are in a recorded frame.

    Each is taken for the recorded object that began nearest to it; one without such an object, or
    with one whose place is unknown, stays where it is.

    :param t: index of the frame.
    :param start_pixels: (K, 2), (u, v) in the start picture of the request.
    :return: float32 (K, 2).
    """
    from scipy.optimize import linear_sum_assignment  # takes a moment to import
    places = np.array(start_pixels, np.float32)
    begun, then = episode.object_pixels[0], episode.object_pixels[t]
    known = np.flatnonzero(np.isfinite(np.concatenate([begun, then], 1)).all(1))
    away = np.linalg.norm(places[:, None] - begun[None, known], axis=-1)
    for k, j in zip(*linear_sum_assignment(away)):
        places[k] = then[known[j]]
    return places
