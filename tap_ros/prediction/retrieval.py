# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which demonstrations are most alike, by small pictures of their start and goal.

Distances are root mean squares of the differences of pixels, 0 to 255, each pixel with a weight.
They are found in whole numbers, so that they are the same on every machine; of equal ones the
first index comes first. Weights are learned, once in a training: demonstrations are alike whose
keyframes are.
"""

from collections.abc import Sequence
import math

import cv2
import numpy as np

SIDE = 16  # px of a small picture, whose pixels are the means of areas
LARGEST = 255.0  # distance of white from black
LARGEST_WEIGHT = 1000
EQUAL = np.ones((2, SIDE, SIDE), np.int32)  # weights of the plain distance
COMPARED, OUTLIER = 5, 2.0  # demonstrations, and factor, see inlier_keyframes
_ROWS = 256  # whose distances from all others are held at once
_LEARNED_FROM = 128  # demonstrations at most
_SHRINKAGE = 0.1  # of learned weights towards equal ones


def ends_of(start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """
    Return what start and goal are compared by.

    :param start: uint8 (H, W, 3) of any size; goal: uint8 (h, w, 3), also of another size.
    :return: uint8 (2, SIDE, SIDE, 3).
    """
    return np.stack([_smaller(start), _smaller(goal)])


def _smaller(picture: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) with SIDE pixels a side."""
    return cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def nearest(asked: np.ndarray, known: np.ndarray, count: int,
            exclude: Sequence[int] | np.ndarray | None = None,
            weights: np.ndarray = EQUAL) -> tuple[np.ndarray, np.ndarray]:
    """
    Find the demonstrations that are most alike.

    :param asked: uint8 (Q, 2, SIDE, SIDE, 3), of ends_of.
    :param known: uint8 (N, 2, SIDE, SIDE, 3), start and goal of others, N of at least 1.
    :param count: of demonstrations for each question; fewer where there are fewer.
    :param exclude: (Q,) the index that each question must not find, for example its own.
    :param weights: int32 (2, SIDE, SIDE) of the pixels, 0 to LARGEST_WEIGHT, not all 0.
    :return: their indices int64 (Q, count) and distances float64 (Q, count), the nearest first.
    """
    count = min(count, len(known) - (exclude is not None))
    columns = known.reshape(len(known), -1).astype(np.float64)  # which hold these sums exactly
    weight = weights.repeat(3).astype(np.float64)
    squares = columns ** 2 @ weight
    indices = np.empty((len(asked), count), np.int64)
    distances = np.empty((len(asked), count))
    for at in range(0, len(asked), _ROWS):
        rows = asked[at:at + _ROWS].reshape(len(asked[at:at + _ROWS]), -1).astype(np.float64)
        sums = (rows ** 2 @ weight)[:, None] + squares - 2 * (rows * weight) @ columns.T
        if exclude is not None:
            sums[np.arange(len(rows)), exclude[at:at + _ROWS]] = np.inf
        found = sums.argsort(1, kind='stable')[:, :count]
        indices[at:at + _ROWS] = found
        distances[at:at + _ROWS] = np.sqrt(
            np.take_along_axis(sums, found, 1) / weight.sum())
    return indices, distances


def nearest_others(asked: np.ndarray, known: np.ndarray, count: int,
                   weights: np.ndarray = EQUAL) -> tuple[np.ndarray, np.ndarray]:
    """
    Find the demonstrations that are most alike, without the one that is asked about.

    One whose start and goal are exactly those that are asked is the same demonstration. It is left
    out, as in training none is its own neighbour; and found where it is the only one.

    :return: as nearest; count is N - 1 at most, or 1.
    """
    indices, distances = nearest(asked, known, count + 1, weights=weights)
    columns = np.arange(max(1, min(count, len(known) - 1))) + (
        (distances[:, :1] == 0) & (len(known) > 1))
    return (np.take_along_axis(indices, columns, 1), np.take_along_axis(distances, columns, 1))


def pad_columns(columns: np.ndarray, count: int) -> np.ndarray:
    """Return columns (N, n) as (N, count), the last one repeated; n is at most count."""
    return np.pad(columns, ((0, 0), (0, count - columns.shape[1])), 'edge')


def neighbours(ends: np.ndarray, count: int,
               weights: np.ndarray = EQUAL) -> tuple[np.ndarray, np.ndarray]:
    """
    Find for each demonstration the others that are most alike; see nearest.

    :param ends: uint8 (N, 2, SIDE, SIDE, 3).
    :return: indices int64 (N, count) and distances (N, count), never of itself; count is N - 1 at
        most.
    """
    return nearest(ends, ends, count, np.arange(len(ends)), weights)


def learned_weights(ends: np.ndarray, keyframes: np.ndarray) -> np.ndarray:
    """
    Learn which pixels of start and goal tell what the keyframe shows.

    The weights for which the squared distances of demonstrations come nearest to those of their
    keyframes, by least squares, none negative, and a little drawn towards equal ones.

    :param ends: uint8 (N, 2, SIDE, SIDE, 3).
    :param keyframes: uint8 (N, ..., H, W, 3), of each demonstration one or several.
    :return: int32 (2, SIDE, SIDE), as nearest takes them; equal ones for fewer than three
        demonstrations, and where all are the same.
    """
    from scipy.optimize import nnls  # takes a moment to import
    some = np.unique(np.linspace(0, len(ends) - 1, min(len(ends), _LEARNED_FROM)).astype(int))
    one, other = np.triu_indices(len(some), 1)
    small = np.stack([_smaller(picture) for picture in keyframes[some].reshape(
        -1, *keyframes.shape[-3:])])
    away, shown = (_squares(part.reshape(len(some), -1, 3).astype(np.float32), one, other)
                   for part in (ends[some], small))
    wanted = shown.mean(1)
    if len(some) < 3 or not away.any() or not wanted.any():
        return EQUAL
    away, wanted = away / away.mean(), wanted / wanted.mean()
    sums = away.sum(1)
    pull = math.sqrt(_SHRINKAGE * len(away))
    found, _ = nnls(np.concatenate([away, pull * np.eye(away.shape[1])]), np.concatenate(
        [wanted, np.full(away.shape[1], pull * (sums @ wanted) / (sums @ sums))]))
    whole = np.round(found * (LARGEST_WEIGHT / max(found.max(), 1e-12))).astype(np.int32)
    return whole.reshape(EQUAL.shape) if whole.any() else EQUAL


def inlier_keyframes(ends: np.ndarray, keyframes: np.ndarray,
                     weights: np.ndarray = EQUAL) -> np.ndarray:
    """
    Return which keyframes look like those of the most alike demonstrations.

    An outlier often has a wrong label. What is compared is the squared distance of small
    pictures from those of the COMPARED most alike demonstrations, in the median.

    :param ends: uint8 (N, 2, SIDE, SIDE, 3); weights: as nearest takes them.
    :param keyframes: uint8 (N, L, H, W, 3); of several levels the distances are added.
    :return: bool (N,), False where the distance is over OUTLIER times that of those most alike
        and that of all, medians both. All True for fewer than three demonstrations.
    """
    if len(ends) < 3:
        return np.ones(len(ends), bool)
    near, _ = neighbours(ends, COMPARED, weights)
    small = np.stack([[_smaller(picture) for picture in each] for each in keyframes])
    rows = small.reshape(len(ends), -1).astype(np.int64)
    away = np.median([((rows[near[:, k]] - rows) ** 2).sum(1) for k in range(near.shape[1])], 0)
    return np.asarray(away <= OUTLIER * np.maximum(np.median(away[near], 1), np.median(away)))


def _squares(pictures: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return squared differences (pairs, P) of the pixels of pictures (N, P, 3)."""
    return ((pictures[one] - pictures[other]) ** 2).mean(-1).astype(np.float64)


def usual_distance(ends: np.ndarray) -> float:
    """
    Return the largest distance of a demonstration from the one most alike.

    A question that is farther from all of them is unlike them. Of one demonstration it is LARGEST:
    nothing tells then.
    """
    return float(neighbours(ends, 1)[1].max()) if len(ends) > 1 else LARGEST


def spread_out(ends: np.ndarray, count: int, weights: np.ndarray = EQUAL) -> np.ndarray:
    """
    Choose demonstrations that cover all of them.

    First the most central one, then always the one farthest from those that are chosen.

    :return: int64 (count,), or all, rising indices.
    """
    if len(ends) <= count:
        return np.arange(len(ends))
    columns = ends.reshape(len(ends), -1).astype(np.float64)
    chosen = [int(nearest(columns.mean(0).round()[None], columns, 1, weights=weights)[0][0, 0])]
    away = np.full(len(ends), np.inf)
    while len(chosen) < count:
        away = np.minimum(
            away, (columns - columns[chosen[-1]]) ** 2 @ weights.repeat(3).astype(np.float64))
        chosen.append(int(away.argmax()))
    return np.sort(chosen)


def places_then(begun: np.ndarray, then: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """
    Say where objects are in a frame of a demonstration.

    Each is taken for the object of the demonstration that began nearest to it.

    :param begun: (J, 2), (u, v) of the objects in the start of the demonstration.
    :param then: (J, 2), in the frame; NaN where unknown, as in begun.
    :param asked: (K, 2), in the start picture that is asked about.
    :return: float32 (K, 2); NaN for one without such an object, or whose place is unknown.
    """
    from scipy.optimize import linear_sum_assignment  # takes a moment to import
    places = np.full(np.shape(asked), np.nan, np.float32)
    known = np.flatnonzero(np.isfinite(np.concatenate([begun, then], 1)).all(1))
    away = np.linalg.norm(np.asarray(asked)[:, None] - begun[None, known], axis=-1)
    for k, j in zip(*linear_sum_assignment(away)):
        places[k] = then[known[j]]
    return places


def unlike(distance: float, usual: float) -> str:
    """Say that a question is unlike all demonstrations; '': it is not."""
    return '' if distance <= usual else (
        f'start and goal are unlike every demonstration: the most alike differs by {distance:.0f}'
        f' (root mean square of pixels, 0 to 255), demonstrations among themselves by '
        f'{usual:.0f} at most')
