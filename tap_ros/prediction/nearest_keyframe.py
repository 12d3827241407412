# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A baseline without a network: keyframes of the recorded episodes most like the task."""

from collections.abc import Iterable, Mapping, Sequence
import os
from typing import Any, Self

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped
from tap_ros.images.crop import trained_crop
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.protocol import check_request, Predictor, Request
from tap_ros.prediction.retrieval import (
    ends_of,
    EQUAL,
    learned_weights,
    nearest_others,
    places_then,
    unlike,
    usual_distance,
)
from tap_ros.prediction.warp import expected_pixels, one_hot_maps
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
from tap_ros.recording.marks import Mark, read_marks
from tap_ros.recording.reading import AS_RECORDED, Reading
import torch

NEIGHBOURS = 5  # episodes whose keyframes are looked at


class NearestKeyframe(Predictor):
    """
    Show the median of the keyframes of the recorded episodes that are most alike.

    These are the NEIGHBOURS with the most alike start and goal pictures, but for the one that is
    asked about, see retrieval.nearest_others; so recordings can be scored by themselves. With
    marks, what is alike is learned from the marked frames. Of each
    the keyframe is the one that is marked, the last where several are; without marks the frame
    half way from the first picture to the last, by what they show. With recursion it is the mark
    before, or half way to the keyframe before. Objects are where they were in the recordings, not
    where the request has them: an object's map is the mean of its places there.

    :param episodes: of one picture size; those with less than two frames are left out.
    :param marks: of episodes by their index, see recording.marks; the others are left out then.
    :raises ConfigError: if there is no episode left.
    """

    mode = 'bidirectional'

    def __init__(self, episodes: Iterable[Episode],
                 marks: Mapping[int, Sequence[Mark]] | None = None) -> None:
        chosen = [(episode, () if marks is None else marks[i])
                  for i, episode in enumerate(episodes)
                  if len(episode) > 1 and (marks is None or i in marks)]
        if not chosen:
            raise ConfigError('nearest_keyframe: no recorded episode has two frames'
                              + ' and marks' * (marks is not None))
        self._episodes, self._marks = zip(*chosen)
        self._ends = np.stack([ends_of(episode.frames[0], episode.frames[-1])
                               for episode in self._episodes])
        self._usual = usual_distance(self._ends)
        self._weights = EQUAL if marks is None else learned_weights(self._ends, np.stack([
            episode.frames[self._keyframe(i, 1, 0)] for i, episode in enumerate(self._episodes)]))
        height, width = self._episodes[0].frames.shape[1:3]
        self.image_size = (height, width)
        self.training: dict[str, Any] = {}
        self.camera_crop = trained_crop(self.training, self.image_size)

    @classmethod
    def load(cls, argument: str, device: Any = 'cpu') -> Self:
        """
        Read recordings, and marks of their episodes, such as `label` writes.

        :param argument: paths, separated by ':' as in PATH; one that ends in .json is of marks,
            and one such as gap=2 no path, but a field of Reading.
        :param device: unused.
        :raises ConfigError: if no path is given, or marks cannot be used; RecordingError: if
            recordings cannot be read.
        """
        parts = list(filter(None, argument.split(os.pathsep)))
        told = {name: value for name, is_told, value in (part.partition('=') for part in parts)
                if is_told and hasattr(AS_RECORDED, name)}
        paths = [part for part in parts if part.partition('=')[0] not in told]
        files = [path for path in paths if path.endswith('.json')]
        if len(files) > 1 or len(files) == len(paths):
            raise ConfigError('nearest_keyframe: name its recordings, and at most one file of '
                              'marks, such as nearest_keyframe:bags/push2 or '
                              'nearest_keyframe:bags/door:labels/labels.marks.json')
        try:
            reading = Reading(**{name: type(getattr(AS_RECORDED, name))(value)
                                 for name, value in told.items()})
        except (TypeError, ValueError) as error:
            raise ConfigError(f'nearest_keyframe: {escaped(error)}; expected a number') from error
        store = open_recordings([path for path in paths if path not in files], progress=False,
                                reading=reading)
        return cls(store, read_marks(files[0], store).episodes if files else None)

    def predict_together(self, requests: Sequence[Request]) -> list[list[Subgoal]]:
        """
        Answer requests; each gets one sample.

        :raises ImageError: if a picture has the wrong type or size, or a position is unusable.
        :raises ConfigError: if a count is below 1, or a goal is missing.
        """
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> list[Subgoal]:
        """Return the keyframes for one request, the earliest first."""
        pictures, pixels = check_request(request, self.mode, self.image_size)
        asked = ends_of(*pictures)[None]
        indices, _ = nearest_others(asked, self._ends, NEIGHBOURS, self._weights)
        alike = [self._episodes[i] for i in indices[0]]
        distance = float(nearest_others(asked, self._ends, 1)[1][0, 0])
        found, at = [], [len(episode) - 1 for episode in alike]
        for level in range(1, request.recursion_depth + 1):
            at = [self._keyframe(i, level, last) for i, last in zip(indices[0], at)]
            places = np.stack([recorded_places(episode, t, pixels[0])
                               for episode, t in zip(alike, at)])
            maps = one_hot_maps(torch.from_numpy(places), self.image_size).mean(0)
            image = np.median([episode.frames[t] for episode, t in zip(alike, at)], 0)
            found.append(Subgoal(
                image.round().astype(np.uint8), maps.numpy(), expected_pixels(maps).numpy(),
                np.ones(len(maps), np.float32), sample=0, level=level, distance=distance,
                warning=unlike(distance, self._usual)))
        return found[::-1]

    def _keyframe(self, i: int, level: int, last: int) -> int:
        """Return the keyframe of an episode at a level of recursion; the one before was `last`."""
        marks = self._marks[i]
        if level <= len(marks):
            return sum(marks[-level]) // 2
        return halfway(self._episodes[i].frames, last)


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
    places = places_then(episode.object_pixels[0], episode.object_pixels[t], start_pixels)
    return np.where(np.isfinite(places), places, np.asarray(start_pixels, np.float32))
