# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether predictions show marked frames, beside what needs no training to choose a frame."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from tap_ros.evaluation import keyframes
from tap_ros.evaluation.intervals import Interval, mean_interval, share_interval
from tap_ros.prediction.marks import chance, features_of, Marks
from tap_ros.prediction.preference import Preference
from tap_ros.recording.cache import EpisodeStore
from tap_ros.training.robot_mask import trained_robot_mask


def score_hits(store: EpisodeStore, marks: Marks, episodes: Sequence[int] | np.ndarray,
               matched: np.ndarray, training: Mapping[str, Any]) -> dict[str, list[Interval]]:
    """
    Say in which share of the marked episodes a frame is a marked one, or at most one beside it.

    :param marks: of at least one of the episodes; of several in an episode any counts.
    :param episodes: (N,) indices of episodes.
    :param matched: (N,), the frames that the predictions match.
    :param training: of the weights; tells the preference, where one was learned.
    :return: of the prediction, the preference alone (its largest w between start and goal), the
        slowest frame, the middle one, and a random one: the shares of hits and of near ones.
    """
    rows = [row for row, i in enumerate(episodes) if int(i) in marks.episodes]
    learned = training.get('marks') or {}
    preferences = [Preference.from_json(one) for one in learned.get('preferences', [])[:1]]
    names = ['prediction', *['preference alone'] * len(preferences), 'slowest', 'middle',
             'UVD-like']
    chosen: dict[str, list[int]] = {name: [] for name in names}
    for row in rows:
        i = int(episodes[row])
        features = features_of(store, i, trained_robot_mask(training)[0])
        frames = [int(matched[row]), *(one.best(features) for one in preferences), *(
            choose(store.frames(i)) for choose in (
                keyframes.slowest, keyframes.middle, keyframes.uvd))]
        for name, frame in zip(names, frames, strict=True):
            chosen[name].append(frame)
    windows = [marks.episodes[int(episodes[row])] for row in rows]
    lengths = [int(store.lengths[episodes[row]]) for row in rows]
    result = {name: [share_interval([
        any(first - off <= frame <= last + off for first, last in window)
        for frame, window in zip(frames, windows)]) for off in (0, 1)]
        for name, frames in chosen.items()}
    result['random'] = [mean_interval([
        min(1.0, sum(chance(mark, length, off) for mark in window))
        for length, window in zip(lengths, windows)]) for off in (0, 1)]
    return result


def print_hits(hits: Mapping[str, Sequence[Interval]], count: int) -> None:
    """Print the table of score_hits."""
    print(f'the matched frame is a marked one, or within one frame of it, in {count} marked '
          'episodes:')
    for name, intervals in hits.items():
        print(f'{name:20s}' + ''.join(
            f'{f"{one.value:.0%} ({one.low:.0%}, {one.high:.0%})":>20s}' for one in intervals))
