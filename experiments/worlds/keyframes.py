# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Keyframes that need no training.

Each takes pictures, uint8 (T, H, W, 3) from start to goal, and returns a frame between them.
"""

import numpy as np

ASIDE = 0.1  # share of the way in pictures that slowest stays away from start and goal


def middle(frames):
    """Return the frame in the middle of the time."""
    return (len(frames) - 1) // 2


def slowest(frames):
    """
    Return the frame where the pictures change least, neither at the start nor at the goal.

    Frames that differ from the start or the goal by less than a tenth of what these differ by do
    not count, since demonstrations often begin and end with a rest.
    """
    start, goal = (_distances(frames, end) for end in (0, -1))
    moves = np.abs(np.diff(frames.astype(np.float32), axis=0)).mean((1, 2, 3))
    speed = _smooth((np.append(moves[:1], moves) + np.append(moves, moves[-1:])) / 2)
    least = ASIDE * start[-1]
    speed[[0, -1]] = np.inf
    return int(np.where((start < least) | (goal < least), np.inf, speed).argmin())


def uvd(frames):
    """
    Return the last subgoal before the goal, as the Universal Visual Decomposer finds it.

    From the goal backwards the distance to it grows; the subgoal is the frame at which it first
    does not. Here distances are of pixels, l1, where Zhang et al. (arXiv:2310.08581) take those of
    a pretrained network. Where the distance grows up to the start there is none: 0.
    """
    distance = _smooth(_distances(frames, -1))
    rest = 0.05 * distance.max()  # what is as near as that is the goal
    last = int(np.flatnonzero(distance > rest).max(initial=0))
    falls = np.flatnonzero(np.diff(distance[:last + 1]) > 0)
    return int(falls.max(initial=-1)) + 1


def _distances(frames, end):
    """Return the l1 distances (T,) to the frame at an end, in pixel values."""
    pictures = frames.astype(np.float32)
    return np.abs(pictures - pictures[end]).mean((1, 2, 3))


def _smooth(curve):
    return np.convolve(np.pad(curve, 1, 'edge'), np.ones(3) / 3, 'valid')
