# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How good predictions are: the paper's metrics on held-out episodes (section 4, appendix E).

All errors are per-pixel means of the absolute difference on [0, 1]. Copying the start or the goal
picture goes through the same measurement: a low error alone proves nothing.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
import math

import numpy as np
from tap_ros.evaluation.bottleneck import (
    MapsOf,
    predicted_maps,
    score_bottlenecks,
    THRESHOLDS,
    VISIBLE,
)
from tap_ros.evaluation.intervals import against_copying, bootstrap, Interval, mean_interval
from tap_ros.evaluation.shown import SHOWN, ShownScorer
from tap_ros.images.pixels import to_float
from tap_ros.messages.subgoals import Subgoal
from tap_ros.prediction.losses import changed_pixels, l1_errors, match_step
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.protocol import Predictor, Request
from tap_ros.prediction.warp import WarpedMaps
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.marks import Mark
from tap_ros.training.batches import Batch, make_batch, Pictures, Sampling
from tap_ros.training.frames import FilledStore
import torch

METHODS = ('prediction', 'copy-start', 'copy-goal')
_BATCH = 64


@dataclass(frozen=True)
class EpisodeScores:
    """
    Measurements of N episodes.

    :param min_l1: (N,), error against the best matching frame between start and goal, or after
        the start where no goal is given.
    :param match_step: (N,), the time of that frame; the start picture is time 0.
    :param match_fraction: (N,), that time as a share of the episode.
    :param changed_l1: (N,), error against the same frame over the pixels alone in which it
        differs from every input (losses.changed_pixels): what copying or leaving out does not
        give; NaN where there are none.
    :param bottleneck: (N,), see bottleneck.score_bottlenecks; NaN where it is undefined.
    :param object_mass: (N,), NaN where it is undefined; below bottleneck.VISIBLE an object is
        left out.
    :param hand: (N,), how much of the hand is shown, see shown.ShownScorer; NaN where unknown.
    :param objects: (N,), how much of the objects is shown; NaN where unknown.
    :param copying: (N,), error of the nearer input against the frame of match_step.
    :param at_mark: (N,), error against the marked frame, of several the one nearest to match_step;
        NaN where none is marked.
    :param copying_at_mark: (N,), error of the nearer input against that frame.
    """

    min_l1: np.ndarray
    match_step: np.ndarray
    match_fraction: np.ndarray
    changed_l1: np.ndarray
    bottleneck: np.ndarray
    object_mass: np.ndarray
    hand: np.ndarray
    objects: np.ndarray
    copying: np.ndarray
    at_mark: np.ndarray
    copying_at_mark: np.ndarray

    def intervals(self) -> dict[str, Interval]:
        """
        Average over the episodes.

        :return: dict from names to Intervals; bottleneck_<n>px is the share of episodes with a
            score of at most n pixels, among those where it is defined; visible_bottleneck_<n>px
            the share of those in which no object is left out either; shows_hand, shows_objects
            and shows_both the shares of those that show them, where the match does.
        """
        result = {
            'min_l1': mean_interval(self.min_l1),
            'copying_l1': mean_interval(self.copying),
            'match_step': mean_interval(self.match_step),
            'match_step_std': bootstrap(partial(np.std, axis=-1), self.match_step),
            'match_fraction': mean_interval(self.match_fraction),
            'match_fraction_std': bootstrap(partial(np.std, axis=-1), self.match_fraction)}
        changed = self.changed_l1[np.isfinite(self.changed_l1)]
        if len(changed):
            result['changed_l1'] = mean_interval(changed)
        scores = self.bottleneck[np.isfinite(self.bottleneck)]
        if len(scores):
            visible = np.where(self.object_mass[np.isfinite(self.bottleneck)] < VISIBLE, np.inf,
                               scores)
            result['bottleneck_median'] = bootstrap(partial(np.median, axis=-1), scores)
            for threshold in THRESHOLDS:
                result[f'bottleneck_{threshold}px'] = mean_interval(scores <= threshold)
                result[f'visible_bottleneck_{threshold}px'] = mean_interval(visible <= threshold)
        both = np.minimum(self.hand, self.objects)
        for name, shares in (('hand', self.hand), ('objects', self.objects), ('both', both)):
            if np.isfinite(shares).any():
                result[f'shows_{name}'] = mean_interval(shares[np.isfinite(shares)] >= SHOWN)
        return result

    def summary(self) -> dict[str, float]:
        """
        Average over the episodes, without intervals.

        :return: dict of numbers: those of intervals, and of how many episodes they are.
        """
        return {'episodes': len(self.min_l1),
                'bottleneck_episodes': int(np.isfinite(self.bottleneck).sum()),
                **{name: interval.value for name, interval in self.intervals().items()}}


def evaluate(network: PredictorNetwork | Predictor, store: EpisodeStore,
             episodes: Sequence[int] | np.ndarray, goal_picture: str = 'last',
             filled: FilledStore | None = None,
             marks: Mapping[int, Sequence[Mark]] = {}) -> dict[str, EpisodeScores]:
    """
    Measure a predictor, and copying, on episodes it was not trained on.

    Without a goal picture in its context the targets are all frames after the start, the last one
    included. With z one sample of each episode is measured, as the paper's genmin + vae.

    :param network: PredictorNetwork in eval mode, or any other Predictor.
    :param store: the EpisodeStore.
    :param episodes: indices of at least one episode, each of at least 3 frames.
    :param goal_picture: see batches.make_batch.
    :param filled: the targets without the robot, see batches.make_batch.
    :param marks: of some episodes, see marks.Marks.
    :return: dict from METHODS (without copy-goal where there is no goal) to EpisodeScores.
    """
    parts: dict[str, list[list[np.ndarray]]] = {}
    for at in range(0, len(episodes), _BATCH):
        chosen = episodes[at:at + _BATCH]
        batch = all_targets(network, store, chosen, goal_picture, filled)
        with torch.inference_mode():
            if isinstance(network, torch.nn.Module):
                batch = batch.to(next(network.parameters()).device)
            image, maps_of = ask(network, batch, chosen)
            measured = to_float(batch.measured)
            images = batch.visible(torch.cat([image[:, None], measured], 1))  # B, 1 + C, 3, H, W
            errors = l1_errors(images, batch.targets.movedim(-1, 2))          # B, 1 + C, T
            placed, mass = score_bottlenecks([store[i] for i in chosen], maps_of, goal_picture)
        scorers = [ShownScorer(store[i]) for i in chosen]
        for m, method in enumerate(METHODS[:errors.shape[1]]):
            match = match_step(errors[:, m], batch.valid)[:, None]
            times = batch.times.gather(1, match)
            copying = errors[:, 1:].amin(1)
            copied = copying.gather(1, match)[:, 0].cpu().numpy()
            at_mark = [_at_mark(marks.get(int(i), ()), int(time), error, copy) for i, time, error,
                       copy in zip(chosen, times[:, 0], errors[:, m], copying)]
            row = [errors[:, m].gather(1, match), times, times / batch.end,
                   _changed_l1(images[:, m], batch, match[:, 0], measured)[:, None]]
            pictures = ((images[:, m] + 1) / 2).movedim(1, -1).cpu().numpy()
            shown = [scorer.score(picture, int(time)) for scorer, picture, time in zip(
                scorers, pictures, times[:, 0].tolist())]
            parts.setdefault(method, []).append(
                [*(part[:, 0].cpu().numpy() for part in row), placed[:, m], mass[:, m],
                 *np.array(shown).T, copied, *np.array(at_mark).T])
    return {method: EpisodeScores(*(np.concatenate(column) for column in zip(*rows)))
            for method, rows in parts.items()}


def _at_mark(marks: Sequence[Mark], time: int, *errors: torch.Tensor) -> list[float]:
    """Return errors (T,), of the frames from the second on, at the mark nearest to a time."""
    middles = [(first + last) // 2 for first, last in marks]
    frame = min(middles, key=lambda t: abs(t - time), default=0)
    return [float(one[frame - 1]) if frame else math.nan for one in errors]


def all_targets(network: PredictorNetwork | Predictor, store: EpisodeStore,
                episodes: Sequence[int] | np.ndarray, goal_picture: str,
                filled: FilledStore | None) -> Batch:
    """Return what a predictor is given of episodes, and all frames that count; see evaluate."""
    forward = network.config.num_context == 1 if isinstance(network, torch.nn.Module) else (
        network.mode == 'forward')
    return make_batch(store, episodes, Sampling(goal_picture=goal_picture, forward=forward),
                      pictures=Pictures(filled=filled))


def ask(network: PredictorNetwork | Predictor, batch: Batch,
        episodes: Sequence[int] | np.ndarray) -> tuple[torch.Tensor, MapsOf]:
    """
    Ask a predictor; of one with z, the first sample that draw_latents draws.

    :param batch: of the episodes.
    :return: pictures (B, 3, H, W) in [-1, 1], and their maps, see score_bottlenecks.
    """
    if not isinstance(network, torch.nn.Module):
        return _ask_another(network, batch)
    device, size, z = next(network.parameters()).device, network.config.latent_size, None
    if size:
        z = draw_latents(episodes, 1, size)[:, 0].to(device)
    prediction = network(to_float(batch.context).to(device), z)
    if (bank := getattr(network, 'bank', None)) is None:
        return prediction.image, lambda b, pixels: predicted_maps(pixels, prediction, b)
    alike, _ = bank.find(batch.context.cpu().numpy(), network.config.num_keyframes)
    return prediction.image, lambda b, pixels: predicted_maps(
        pixels, prediction, b, bank, alike[b])


def draw_latents(episodes: Iterable[int], count: int, size: int) -> torch.Tensor:
    """
    Draw z from the prior, for each episode its own, whichever others are asked for.

    :param episodes: (B,) indices of episodes.
    :param count: samples of each; fewer are the first ones of more.
    :param size: length of z.
    :return: float32 (B, count, size).
    """
    return torch.from_numpy(np.stack([
        np.random.default_rng([0, int(i)]).standard_normal((count, size), np.float32)
        for i in episodes]))


def _ask_another(predictor: Predictor, batch: Batch) -> tuple[torch.Tensor, MapsOf]:
    """Return what another predictor shows, as ask."""
    def answer(b: int, pixels: np.ndarray) -> Subgoal:
        names = ('start', 'goal')[:batch.context.shape[1]]
        return predictor.predict_together([Request(
            **dict(zip(names, batch.context[b].numpy())),
            **{f'{name}_pixels': at for name, at in zip(names, pixels)})])[0][0]

    def maps_of(b: int, pixels: np.ndarray) -> WarpedMaps:
        subgoal = answer(b, pixels)
        return WarpedMaps(torch.from_numpy(subgoal.object_maps), torch.from_numpy(subgoal.mass))

    nothing = np.zeros((2, 0, 2), np.float32)
    images = [answer(b, nothing).image for b in range(len(batch.context))]
    return to_float(np.stack(images)), maps_of


def _changed_l1(images: torch.Tensor, batch: Batch, match: torch.Tensor,
                context: torch.Tensor) -> torch.Tensor:
    """Measure EpisodeScores.changed_l1 of pictures (B, 3, H, W); return (B,)."""
    targets = to_float(batch.targets[torch.arange(len(match)), match])
    changed = changed_pixels(targets, context)  # B, 1, H, W
    error = ((images - targets).abs().mean(1, keepdim=True) / 2 * changed).sum((1, 2, 3))
    return error / changed.sum((1, 2, 3))  # 0 / 0 is NaN


def verdict(scored: EpisodeScores, training: EpisodeScores | None,
            name: str = 'held-out episodes') -> list[str]:
    """
    Compare predictions with copying the nearer input, both at the matched frame, in words.

    A low error alone says nothing: frames beside an input are predicted well by copying it.

    :param scored: scores of episodes, by default not trained on; training: of some that were.
    :param name: of those that are scored.
    :return: lines.
    """
    lines, words = [], []
    for title, scores in ((name, scored), ('training episodes', training)):
        if scores is None:
            continue
        word, ratio = against_copying(scores.min_l1, scores.copying)
        words.append(word)
        lines.append(f'{title}, at the matched frame: {word}; error '
                     f'{scores.min_l1.mean():.4f}, copying {scores.copying.mean():.4f}: '
                     f'{ratio.value:.2f} times ({ratio.low:.2f}, {ratio.high:.2f})')
    if words[0] in ('worse than copying', 'not told from copying') and words[1:] == [
            'better than copying']:
        lines.append('memorised: only what it was trained on is predicted better than by copying; '
                     'record more, or train fewer steps')
    return lines
