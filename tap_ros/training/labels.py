# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Labels: the moments that a few marks name, found in every demonstration of a data set.

Each named mark gets a softmax over the frames of a demonstration, of a linear function of what the
pictures show around a frame. The marks of a demonstration are decoded together: they come in their
order, about as far apart as in the demonstrations that were marked. Several such models, which see
more or less around a frame and of its picture, are averaged, each weighed by how likely it makes
marks that it was not learned from.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import math
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.progress import Progress
from tap_ros.base.text import listing
from tap_ros.training.preference import describe, FEATURES, LEAST_FRAMES

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

SIZE = 64  # px a side of the pictures that are described: whole ones, squeezed into a square
USUAL_S = 8.0  # of a demonstration; in shorter ones all times below are shorter alike
RATE = 10.0  # Hz, at most, of the frames that may be labels
MOTION_RATE = 5.0  # Hz, about, of the frames between which motion is described
AROUND_S = (-0.6, -0.3, 0.0, 0.3, 0.6)  # of the frames that are described together
REACH_S = (0.0, 0.3, 0.6)  # how far around a frame models look: of AROUND_S so many
# Weights that the small grey picture has in models: of pixels in their deviations; and as they
# are, so that one in which little happens says little.
GREY, PLAIN_GREY = (0.0, 0.1, 0.3, 1.0), (0.3, 1.0, 2.0)
LEAST_SHARE = 1e-3  # of a model that counts in the average
FOLDS = 20  # of the marked demonstrations, at most, that are left out in turn; of so few each one
RIDGE = 0.2  # price of the squared weights, in nats; features have variance 1
SPREAD_S = 0.1  # a mark is off by so much as often as not
TOLERANCE_S = 0.3  # within which a label is held to be right
LOOSER = (1.0, 5 / 3, 10 / 3)  # times that, 0.3, 0.5 and 1 s: labels miss as few as can be
LEAST_GAP_S = 0.4  # the least deviation of the time between two marks


@dataclass(frozen=True)
class Film:
    """
    What the pictures of a demonstration show around each of its frames, at RATE at most.

    :param stamps: (T,) s.
    :param features: (T, D) float64: FEATURES at the times AROUND_S, also of other cameras, and
        signals; then the small grey picture of each camera.
    :param grey: how many of the last columns are those of pictures.
    :param around: (D,) s, of AROUND_S the one of each column; 0 of the grey pictures.
    """

    stamps: np.ndarray
    features: np.ndarray
    grey: int
    around: np.ndarray

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.stamps)

    @property
    def pace(self) -> float:
        """The factor, up to 1, on all times, see USUAL_S."""
        return _pace(self.stamps[-1])

    @property
    def tolerance(self) -> float:
        """Within how many s a label is held to be right: a frame at least."""
        return max(TOLERANCE_S * self.pace, self.step) + 1e-6

    @property
    def step(self) -> float:
        """The longest time between two frames, in s."""
        return float(np.diff(self.stamps).max(initial=0))

    @property
    def slowest(self) -> int:
        """Return the frame between the first and the last one in which least moves."""
        speed = self.features[:, len(FEATURES) * (len(AROUND_S) // 2) + FEATURES.index('speed')]
        return 1 + int(speed[1:-1].argmin())

    def near(self, second: float, within_s: float) -> float:
        """Return which share of the frames between the ends is near to a time."""
        return float((np.abs(self.stamps[1:-1] - second) <= within_s + 1e-6).mean())

    def nearest(self, second: float) -> int:
        """Return the frame nearest to a time, between the first and the last one."""
        return int(np.clip(np.abs(self.stamps - second).argmin(), 1, len(self) - 2))


def film_of(store: 'EpisodeStore', i: int, hidden: np.ndarray | None = None) -> Film | None:
    """Describe a demonstration of a store, see film; None for one that is too short."""
    return None if store.lengths[i] < LEAST_FRAMES else film(
        store.frames(i), store[i].stamps, hidden)


def film(frames: np.ndarray, stamps_ns: np.ndarray, hidden: np.ndarray | None = None) -> Film:
    """
    Describe the frames of a demonstration.

    :param frames: (T, H, W, 3) uint8, at least LEAST_FRAMES.
    :param stamps_ns: (T,) ns, rising.
    :param hidden: (T, H, W) bool, pixels that do not count, such as the robot's; None: none.
    :raises ConfigError: for fewer frames.
    """
    pace = _pace((stamps_ns[-1] - stamps_ns[0]) / 1e9)
    step = _every(stamps_ns, RATE / pace)
    index = np.arange(0, len(frames), step)
    if len(index) < LEAST_FRAMES:
        index = np.arange(len(frames))
    stamps = (stamps_ns[index] - stamps_ns[0]) / 1e9
    pictures, hidden = frames[index], None if hidden is None else hidden[index]
    # Motion between frames that are close is noise: every second, third... frame has its own.
    step = min(_every(stamps_ns[index], MOTION_RATE / pace), max(1, len(index) // LEAST_FRAMES))
    found = np.empty((len(index), len(FEATURES)))
    phases = [describe(pictures[k::step], None if hidden is None else hidden[k::step])
              for k in range(step)]
    for column in range(len(FEATURES)):
        found[:, column] = np.mean([
            np.interp(np.arange(len(index)), np.arange(k, len(index), step), phase[:, column])
            for k, phase in enumerate(phases)], 0)
    near = np.abs(stamps[:, None, None] + pace * np.array(AROUND_S)[:, None] - stamps).argmin(-1)
    grey = np.empty((len(index), phases[0].shape[1] - len(FEATURES)))
    for k, phase in enumerate(phases):
        grey[k::step] = phase[:, len(FEATURES):]
    return Film(
        stamps, np.concatenate([found[near].reshape(len(index), -1), grey], 1), grey.shape[1],
        np.append(np.repeat(AROUND_S, len(FEATURES)), np.zeros(grey.shape[1])))


@dataclass(frozen=True)
class Labels:
    """
    The moments of the demonstrations of a data set.

    :param names: of M marks, in their order.
    :param moments: of each demonstration (M,) s from its first frame; NaN in those too short.
    :param confidence: of each (M,), 0 to 1: how likely the moment is right within TOLERANCE_S; 1
        of those that were marked.
    :param left_out: of each that was marked, in their order, what the others make of it: (M,) s;
        none where fewer than three are marked.
    """

    names: tuple[str, ...]
    moments: list[np.ndarray]
    confidence: list[np.ndarray]
    left_out: list[np.ndarray]


class MomentModel:
    """
    Finds the moments of marks in demonstrations.

    :param films: that were marked.
    :param moments: of each (M,) s.
    :param grey: weight of the small grey picture; below 0: of its pixels as they are.
    :param reach: s around a frame, of AROUND_S, that count.
    :param like: a model of nearly the same marks, from which the search for weights begins.
    :raises ConfigError: without marks, or where not all have as many.
    """

    def __init__(self, films: Sequence[Film], moments: Sequence[np.ndarray], grey: float,
                 reach: float = AROUND_S[-1], like: 'MomentModel | None' = None) -> None:
        if not films or len({len(one) for one in moments}) != 1 or not len(moments[0]):
            raise ConfigError('marks: expected some demonstrations with the same marks each; mark '
                              'ten')
        everything = np.concatenate([one.features for one in films])
        self._mean, self._scale = everything.mean(0), 1 / np.maximum(everything.std(0), 1e-6)
        pixels = slice(-films[0].grey, None)
        self._scale[pixels] = -grey if grey < 0 else grey * self._scale[pixels]
        self._scale[np.abs(films[0].around) > reach + 1e-6] = 0
        inputs = [self._inputs(one) for one in films]
        self._weights: np.ndarray = np.stack([
            _most_likely(inputs, [spread(one, second[m]) for one, second in zip(films, moments)],
                         None if like is None else like._weights[:, m])
            for m in range(len(moments[0]))], 1)
        gaps = np.diff(np.stack(moments), axis=1)  # (N, M - 1) s
        self._gap = gaps.mean(0)
        wide = gaps.var(0, ddof=1) if len(gaps) > 1 else np.full(len(self._gap), math.inf)
        least = LEAST_GAP_S * float(np.mean([one.pace for one in films]))
        self._gap_deviation = np.sqrt(wide * (1 + 1 / len(gaps)) + least ** 2)

    def log_posterior(self, one: Film) -> np.ndarray:
        """Return log of the posterior of each mark and frame, (M, T), all marks in their order."""
        z = (self._inputs(one) @ self._weights).T  # (M, T)
        z[:, [0, -1]] = -np.inf  # start and goal are no moments between them
        z -= _log_sum(z)[:, None]
        if len(z) == 1:
            return z
        gap = one.stamps[None] - one.stamps[:, None]  # (T, T), later minus earlier
        links = [np.where(gap > 0, -0.5 * ((gap - mean) / deviation) ** 2, -np.inf)
                 for mean, deviation in zip(self._gap, self._gap_deviation)]
        forward, backward = [z[0]], [np.zeros(len(one))]
        for m, link in enumerate(links):
            forward.append(z[m + 1] + _log_sum((forward[m][:, None] + link).T))
        for m in range(len(links) - 1, -1, -1):
            backward.append(_log_sum(links[m] + z[m + 1] + backward[-1]))
        found = np.stack(forward) + np.stack(backward[::-1])
        return found - _log_sum(found)[:, None]

    def _inputs(self, one: Film) -> np.ndarray:
        return (one.features - self._mean) * self._scale


class Average:
    """
    The average of several models.

    :param models: MomentModels of the same marks.
    :param worth: of each, the logarithm of how likely it made marks not seen.
    """

    def __init__(self, models: Sequence[MomentModel], worth: np.ndarray) -> None:
        share = np.exp(worth - _log_sum(worth))
        self._models = [(model, math.log(one)) for model, one in zip(models, share.tolist())
                        if one >= LEAST_SHARE]

    def log_posterior(self, one: Film) -> np.ndarray:
        """Return log of the posterior of each mark and frame, (M, T)."""
        found = _log_sum(np.stack([
            log_share + model.log_posterior(one) for model, log_share in self._models], -1))
        return np.asarray(found - _log_sum(found)[:, None])


def moments_of(one: Film, log_posterior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the moments (M,) s of least loss, and how likely they are right within TOLERANCE_S.

    The loss of a moment is how many of the tolerances LOOSER it is expected to miss.

    :param log_posterior: (M, T), as MomentModel returns it.
    """
    gap = np.abs(one.stamps[:, None] - one.stamps)
    mass = np.stack([np.exp(log_posterior) @ (gap <= one.tolerance * times) for times in LOOSER])
    mass[..., [0, -1]] = 0
    best = mass.sum(0).argmax(1)
    return one.stamps[best], mass[0, np.arange(len(best)), best].clip(0, 1)


def fit(films: Sequence[Film], moments: Sequence[np.ndarray],
        progress: bool = False) -> tuple[MomentModel | Average, list[np.ndarray]]:
    """
    Learn models from marks, and from all marks but those of each fold, to weigh them.

    :param films: that were marked; moments: of each (M,) s.
    :param progress: show a bar.
    :return: the average, and of each what the others make of it, see Labels.left_out.
    :raises ConfigError: see MomentModel.
    """
    if len(films) < 3:
        return MomentModel(films, moments, GREY[1]), []
    kinds = list(product((*GREY, *(-one for one in PLAIN_GREY)), REACH_S))
    models = [MomentModel(films, moments, *kind) for kind in kinds]
    worth, folds = np.empty((len(models), len(films))), list[list[MomentModel]]()
    for first in Progress(range(min(FOLDS, len(films))), 'learning from marks',
                          disable=not progress, delay=1):
        rest = [i for i in range(len(films)) if i % FOLDS != first]
        marked = [films[i] for i in rest], [moments[i] for i in rest]
        folds.append([MomentModel(*marked, *kind, like) for kind, like in zip(kinds, models)])
    for i, (one, marks) in enumerate(zip(films, moments)):
        near = np.abs(one.stamps - marks[:, None]) <= one.tolerance  # (M, T)
        for k, model in enumerate(folds[i % FOLDS]):
            right = (np.exp(model.log_posterior(one)) * near).sum(1)
            worth[k, i] = np.log(right + 1e-3).sum()
    total = worth.sum(1)
    return Average(models, total), [
        moments_of(one, Average(folds[i % FOLDS], total - worth[:, i]).log_posterior(one))[0]
        for i, one in enumerate(films)]


def label(films: Sequence[Film | None], marked: Mapping[int, np.ndarray],
          names: Sequence[str], progress: bool = False) -> Labels:
    """
    Find the moments of all demonstrations.

    :param films: of each demonstration its Film; None of one that is too short to be marked.
    :param marked: {demonstration: moments (M,) s}.
    :param names: of the M marks.
    :param progress: show a bar.
    :raises ConfigError: see MomentModel; for as many names as there are not marks.
    """
    if any(len(moments) != len(names) for moments in marked.values()):
        raise ConfigError(f'marks: expected {len(names)} in each demonstration, '
                          f'{listing(names)}, got {sorted({*map(len, marked.values())})}')
    model, left_out = fit([film for i in marked if (film := films[i])], list(marked.values()),
                          progress)
    found = Labels(tuple(names), [], [], left_out)
    for i, one in enumerate(films):
        moments, confidence = np.full((2, len(names)), math.nan)
        if i in marked:
            moments, confidence = marked[i], np.ones(len(names))
        elif one is not None:
            moments, confidence = moments_of(one, model.log_posterior(one))
        found.moments.append(moments)
        found.confidence.append(confidence)
    return found


def _pace(seconds: float) -> float:
    return min(1.0, max(seconds, 1e-3) / USUAL_S)


def _every(stamps_ns: np.ndarray, rate: float) -> int:
    """Return the stride with which frames come at about this rate."""
    seconds = (stamps_ns[-1] - stamps_ns[0]) / 1e9
    return max(1, round((len(stamps_ns) - 1) / max(seconds, 1e-9) / rate)) if seconds > 0 else 1


def spread(one: Film, second: float) -> np.ndarray:
    """Return the probability (T,) that a person means a frame by this mark."""
    off = max(SPREAD_S * one.pace, one.step)
    share = np.maximum(0, 1 - np.abs(one.stamps - one.stamps[one.nearest(second)]) / (2 * off))
    return share / share.sum()


def _most_likely(inputs: Sequence[np.ndarray], wanted: Sequence[np.ndarray],
                 start: np.ndarray | None) -> np.ndarray:
    """
    Return the weights a (D,) of the most likely softmax over frames, with a ridge.

    Minimises sum_n -wanted_n . log softmax(x_n a) + RIDGE |a|^2, which is convex.

    :param inputs: (T, D) each; wanted: (T,) each, adding up to 1.
    :param start: (D,), from which to search; None: 0.
    """
    from scipy.optimize import minimize  # takes a moment to import
    rows = np.concatenate(inputs)
    target = np.concatenate(wanted) @ rows
    firsts = np.cumsum([0, *(len(x) for x in inputs[:-1])])
    of_film = np.repeat(np.arange(len(inputs)), [len(x) for x in inputs])

    def loss(a: np.ndarray) -> tuple[float, np.ndarray]:
        z = rows @ a
        largest = np.maximum.reduceat(z, firsts)
        share = np.exp(z - largest[of_film])
        total = np.add.reduceat(share, firsts)
        value = (largest + np.log(total)).sum() + (RIDGE * a - target) @ a
        return float(value), 2 * RIDGE * a - target + (share / total[of_film]) @ rows

    return np.asarray(minimize(
        loss, np.zeros(rows.shape[1]) if start is None else start, jac=True, method='L-BFGS-B',
        options={'maxiter': 300}).x)


def _log_sum(z: np.ndarray) -> np.ndarray:
    """Return log sum exp over the last axis; -inf of nothing."""
    largest = np.maximum(z.max(-1), -1e300)
    with np.errstate(divide='ignore'):
        return np.asarray(largest + np.log(np.exp(z - largest[..., None]).sum(-1)))
