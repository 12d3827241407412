# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the pictures of a demonstration show at each frame, and a preference w(t) by it (Eq. 5).

The features are what every sequence of pictures has: where a frame is in time and on the way from
start to goal, how fast the pictures change there, whether that slows down, and where; and the
picture, small and grey. Labels (labels.py) are learned from them; `still` needs no marks.
"""

import cv2
import numpy as np
from tap_ros.base.errors import ConfigError

FEATURES = ('time', 'progress', 'distance to both', 'speed', 'distance to start',
            'distance to goal', 'change of speed', 'column of motion', 'row of motion',
            'motion to change')
SMALL = 8  # pixels a side of the grey picture
SIZE = len(FEATURES) + SMALL ** 2
LEAST_FRAMES = 3
WINDOW = 4  # frames, before and after, between which speed changes
BESIDE = 2  # frames, before and after, whose motion has one place


def describe(frames: np.ndarray, hidden: np.ndarray | None = None) -> np.ndarray:
    """
    Compute the features of each frame; brightness and contrast of the camera change none of them.

    Distances are l1, speed is the distance to the frames beside. Progress is (d_0 - d_T) / (d_0 +
    d_T), with d_0 and d_T the distances to start and goal. Motion is where squared differences of
    frames have their centre, in shares of the picture; change, where those of start and goal do.
    The small pictures of a demonstration have together mean 0 and variance 1.

    :param frames: uint8 (T, H, W, 3), T at least 3: start, what lies between, goal.
    :param hidden: bool (T, H, W), pixels that do not count, such as the robot's; None: none.
    :return: float64 (T, SIZE): FEATURES, then the small grey picture.
    :raises ConfigError: for fewer frames.
    """
    T = len(frames)
    if T < LEAST_FRAMES:
        raise ConfigError(f'a demonstration of {T} frames; expected at least {LEAST_FRAMES}')
    pictures = frames.astype(np.float32)

    def difference(a: int, b: int) -> tuple[np.ndarray, float]:
        """Return how much pixels (H, W) differ, 0 where hidden, and the mean of the others."""
        gap = np.abs(pictures[a] - pictures[b]).mean(-1)
        if hidden is None:
            return gap, float(gap.mean())
        seen = ~(hidden[a] | hidden[b])
        return np.where(seen, gap, 0), float(gap[seen].mean()) if seen.any() else 0.0

    start, goal = (np.array([difference(end, t)[1] for t in range(T)]) for end in (0, T - 1))
    moving, moves = map(np.array, zip(*(difference(t, t + 1) for t in range(T - 1))))
    places = np.array([_centre((moving[max(0, t - BESIDE):t + BESIDE] ** 2).sum(0))
                       for t in range(T)])
    away = np.linalg.norm(places - _centre(difference(0, T - 1)[0] ** 2), axis=1)
    speed = (np.append(moves[:1], moves) + np.append(moves, moves[-1:])) / 2
    usual, largest = max(speed.mean(), 1e-6), max(start.max(), goal.max(), 1e-6)
    nearer = np.minimum(start, goal)
    before = np.array([speed[max(0, t + 1 - WINDOW):t + 1].mean() for t in range(T)])
    after = np.array([speed[t:t + WINDOW].mean() for t in range(T)])
    log_speed = np.pad(np.log(speed / usual + 0.1), 1, 'edge')
    return np.concatenate([np.stack([
        np.arange(T) / (T - 1), (start - goal) / np.maximum(start + goal, 1e-6),
        nearer / max(nearer.max(), 1e-6), np.convolve(log_speed, np.ones(3) / 3, 'valid'),
        start / largest, goal / largest,
        np.log((after + 0.1 * usual) / (before + 0.1 * usual)), *places.T, away], 1),
        _small(pictures.mean(-1), hidden)], 1)


def still(features: np.ndarray) -> np.ndarray:
    """
    Prefer frames in which little moves, as hands hesitate where it matters.

    w(t) is the bell over time, see losses.bell_preference, over the speed.

    :param features: (T, SIZE), as describe returns them.
    :return: w (T,), 1 at most.
    """
    time, speed = features[:, FEATURES.index('time')], features[:, FEATURES.index('speed')]
    w = (2 / 3) ** (2 * time - 1) ** 2 / (np.exp(speed) + 0.2)
    return np.asarray(w / w.max())


def _centre(mass: np.ndarray) -> np.ndarray:
    """Return column and row of the centre of mass (H, W), 0 to 1; the middle of none."""
    total = mass.sum()
    at = [(mass.sum(axis) @ (np.arange(n) + 0.5)) / (total * n) if total else 0.5
          for axis, n in enumerate(mass.shape[::-1])]
    return np.array(at)


def _small(grey: np.ndarray, hidden: np.ndarray | None) -> np.ndarray:
    """Return pictures (T, H, W) as (T, SMALL ** 2), see describe; what is hidden is 0."""
    seen = np.ones_like(grey) if hidden is None else (~hidden).astype(np.float32)
    light, count = (np.stack([cv2.resize(one, (SMALL, SMALL), interpolation=cv2.INTER_AREA).ravel()
                              for one in pictures]) for pictures in (grey * seen, seen))
    found = light / np.maximum(count, 1e-6)
    found = np.where(count > 0, found - found[count > 0].mean(), 0) if count.any() else 0 * found
    return np.asarray(found / max(found.std(), 1e-6))
