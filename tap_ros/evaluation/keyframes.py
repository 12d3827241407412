# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Keyframes that need no training, or a few marks only; and how often one, or a prediction, is right.

Each takes pictures, uint8 (T, H, W, 3) from start to goal, and returns a frame between them.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from tap_ros.evaluation.intervals import Interval, mean_interval, share_interval
from tap_ros.images.robot_mask import trained_robot_mask
from tap_ros.prediction.nearest_keyframe import halfway, l1_distance
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.marks import Mark, Marks
from tap_ros.training.marks import chance, features_of
from tap_ros.training.preference import describe, learn_preference, Preference, SIZE

ASIDE = 0.1  # share of the way in pictures that slowest stays away from start and goal
SMOOTH = np.ones(3) / 3


def middle(frames: np.ndarray) -> int:
    """Return the frame in the middle of the time."""
    return (len(frames) - 1) // 2


def slowest(frames: np.ndarray) -> int:
    """
    Return the frame where the pictures change least, neither at the start nor at the goal.

    Frames that differ from the start or the goal by less than a tenth of what these differ by do
    not count, since demonstrations often begin and end with a rest.
    """
    start, goal = (_distances(frames, end) for end in (0, -1))
    moves = np.abs(np.diff(frames.astype(np.float32), axis=0)).mean((1, 2, 3))
    speed = np.convolve(np.pad((np.append(moves[:1], moves) + np.append(moves, moves[-1:])) / 2, 1,
                               'edge'), SMOOTH, 'valid')
    least = ASIDE * start[-1]
    speed[[0, -1]] = np.inf
    return int(np.where((start < least) | (goal < least), np.inf, speed).argmin())


def uvd(frames: np.ndarray) -> int:
    """
    Return the last subgoal before the goal, as the Universal Visual Decomposer finds it.

    From the goal backwards the distance to it grows; the subgoal is the frame at which it first
    does not. Here distances are of pixels, l1, where Zhang et al. (arXiv:2310.08581) take those of
    a pretrained network. Where the distance grows up to the start there is none: 0.
    """
    distance = np.convolve(np.pad(_distances(frames, -1), 1, 'edge'), SMOOTH, 'valid')
    rest = 0.05 * distance.max()  # what is as near as that is the goal
    last = int(np.flatnonzero(distance > rest).max(initial=0))
    falls = np.flatnonzero(np.diff(distance[:last + 1]) > 0)
    return int(falls.max(initial=-1)) + 1


def from_marks(marked: Sequence[np.ndarray],
               marks: Sequence[int]) -> Callable[[np.ndarray], int]:
    """
    Learn a time preference from marks; see preference.Preference.

    :param marked: list of demonstrations; marks: the frame that is marked in each.
    :return: function of a demonstration to the frame that is preferred.
    """
    preference = learn_preference([describe(frames) for frames in marked], marks)
    return lambda frames: preference.best(describe(frames))


def _distances(frames: np.ndarray, end: int) -> np.ndarray:
    """Return the l1 distances (T,) to the frame at an end, in pixel values."""
    pictures = frames.astype(np.float32)
    return np.asarray(np.abs(pictures - pictures[end]).mean((1, 2, 3)))


def score_hits(store: EpisodeStore, marks: Marks, episodes: np.ndarray, others: np.ndarray,
               matched: np.ndarray, training: Mapping[str, Any]) -> dict[str, list[Interval]]:
    """
    Say in which share of the marked episodes a frame is a marked one, or at most one beside it.

    :param marks: of at least one of the episodes; of several in an episode any counts.
    :param episodes: (N,) indices of episodes.
    :param others: of demonstrations to be compared with, as a rule those trained on.
    :param matched: (N,), the frames that the predictions match.
    :param training: of the weights; tells the preference, where one was learned.
    :return: of the prediction, the preference alone (its largest w between start and goal), the
        nearest demonstration (see nearest_frame), keyframes and a random frame: the shares of
        hits and of near ones.
    """
    rows = [row for row, i in enumerate(episodes) if int(i) in marks.episodes]
    scored = [int(episodes[row]) for row in rows]
    frames = {'prediction': [int(matched[row]) for row in rows]}
    for one in (training.get('marks') or {}).get('preferences', [])[:1]:
        if len(one['weights']) != SIZE:  # of an earlier version, of other features
            continue
        preference, robot_mask = Preference.from_json(one), trained_robot_mask(training)[0]
        frames['preference alone'] = [
            preference.best(features_of(store, i, robot_mask)) for i in scored]
    if set(others.tolist()) - set(scored[:1]):
        frames['nearest demonstration'] = [
            nearest_frame(store, i, others.tolist(), marks) for i in scored]
    keyframes: dict[str, Callable[[np.ndarray], int]] = {
        'slowest': slowest, 'middle': middle, 'UVD-like': uvd}
    for name, choose in keyframes.items():
        frames[name] = [choose(store.frames(i)) for i in scored]
    windows = [marks.episodes[i] for i in scored]
    result = {name: [share_interval([
        is_hit(window, frame, off) for frame, window in zip(each, windows)]) for off in (0, 1)]
        for name, each in frames.items()}
    result['random'] = [mean_interval([
        min(1.0, sum(chance(mark, int(store.lengths[i]), off) for mark in window))
        for i, window in zip(scored, windows)]) for off in (0, 1)]
    return result


def is_hit(window: Sequence[Mark], frame: int, off: int = 0) -> bool:
    """Say whether a frame is within one of the marks of its episode, or so many beside it."""
    return any(first - off <= frame <= last + off for first, last in window)


def nearest_frame(store: EpisodeStore, i: int, others: Sequence[int], marks: Marks) -> int:
    """
    Return the frame of an episode that is nearest to the keyframe of another demonstration.

    :param others: the one whose start and goal pictures are nearest is taken: of those with
        marks, and its keyframe is its last mark; where none has, of all, and its keyframe is the
        one half way, as nearest_keyframe shows it. The episode itself does not count.
    """
    others = [j for j in others if j != i]
    marked = [j for j in others if j in marks.episodes]
    frames = store.frames(i)
    like = min(marked or others, key=lambda j: l1_distance(
        store.frames(j)[[0, -1]], frames[[0, -1]]))
    shown = store.frames(like)
    at = sum(marks.episodes[like][-1]) // 2 if marked else halfway(shown, len(shown) - 1)
    return min(range(1, len(frames) - 1), key=lambda t: l1_distance(frames[t], shown[at]))


def print_hits(hits: Mapping[str, Sequence[Interval]], count: int) -> None:
    """Print the table of score_hits."""
    print(f'the matched frame is a marked one, or within one frame of it, in {count} marked '
          'episodes:')
    for name, intervals in hits.items():
        print(f'{name:22s}' + ''.join(
            f'{f"{one.value:.0%} ({one.low:.0%}, {one.high:.0%})":>20s}' for one in intervals))
