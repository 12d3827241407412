# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How good predictions are: the paper's metrics on held-out episodes (section 4, appendix E).

All errors are per-pixel means of the absolute difference on [0, 1]. Copying the start or the goal
picture goes through the same measurement: a low error alone proves nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.evaluation.bottleneck import (
    context_pixels,
    MapsOf,
    predicted_maps,
    score_bottlenecks,
    THRESHOLDS,
    VISIBLE,
)
from tap_ros.evaluation.hits import print_hits, score_hits
from tap_ros.evaluation.intervals import bootstrap, Interval, mean_interval
from tap_ros.evaluation.samples import draw_latents, SAMPLES, SampleScores, score_samples
from tap_ros.evaluation.shown import SHOWN, ShownScorer
from tap_ros.files import write_atomically
from tap_ros.images.drawing import grid, overlay
from tap_ros.images.pixels import to_float, to_uint8
from tap_ros.messages.subgoals import Subgoal
from tap_ros.options import Bags, File, Flag, Folder, Topic
from tap_ros.prediction.batches import Batch, make_batch, Sampling
from tap_ros.prediction.losses import changed_pixels, l1_errors, match_step
from tap_ros.prediction.marks import read_marks
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.protocol import load_predictor, Predictor, predictor_files, Question
from tap_ros.prediction.warp import WarpedMaps
from tap_ros.recording.bags import reading_like
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.text import listing
from tap_ros.training.inpainted import fill, Filled, with_masks
from tap_ros.training.robot_mask import trained_robot_mask
from tap_ros.training.split import split_episodes, TEST_FRACTION, warn_if_few
from tap_ros.weights import PREDICTORS
import torch
from tyro import conf

METHODS = ('prediction', 'copy-start', 'copy-goal')
_BATCH = 64
_SHOWN = ('min_l1', 'copying_l1', 'changed_l1', 'match_fraction', 'match_fraction_std',
          'bottleneck_median', 'bottleneck_1px', 'bottleneck_2px', 'visible_bottleneck_2px',
          'bottleneck_5px', 'shows_hand', 'shows_objects', 'shows_both')


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
    :param object_mass: (N,), likewise; below bottleneck.VISIBLE an object is left out.
    :param hand: (N,), how much of the hand is shown, see shown.ShownScorer; NaN where unknown.
    :param objects: (N,), likewise of the objects.
    :param copying: (N,), error of the nearer input against the frame of match_step.
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
             filled: Filled | None = None) -> dict[str, EpisodeScores]:
    """
    Measure a predictor, and copying, on episodes it was not trained on.

    Without a goal picture in its context the targets are all frames after the start, the last one
    included. With z one sample of each episode is measured, as the paper's genmin + vae.

    :param network: PredictorNetwork in eval mode, or any other Predictor.
    :param store: the EpisodeStore.
    :param episodes: indices of at least one episode, each of at least 3 frames.
    :param goal_picture: see batches.make_batch.
    :param filled: the targets without the robot, see batches.make_batch.
    :return: dict from METHODS (without copy-goal where there is no goal) to EpisodeScores.
    """
    forward = _is_forward(network)
    methods = METHODS[:2] if forward else METHODS
    parts: dict[str, list[list[np.ndarray]]] = {method: [] for method in methods}
    for at in range(0, len(episodes), _BATCH):
        chosen = episodes[at:at + _BATCH]
        batch = make_batch(store, chosen, Sampling(
            goal_picture=goal_picture, forward=forward), filled=filled)
        with torch.inference_mode():
            if isinstance(network, torch.nn.Module):
                batch = batch.to(next(network.parameters()).device)
                image, maps_of = _ask_network(network, batch, chosen)
            else:
                image, maps_of = _ask(network, batch)
            measured = to_float(batch.measured)
            images = batch.visible(torch.cat([image[:, None], measured], 1))  # B, 1 + C, 3, H, W
            errors = l1_errors(images, batch.targets.movedim(-1, 2))          # B, 1 + C, T
            placed, mass = score_bottlenecks([store[i] for i in chosen], maps_of, goal_picture)
        scorers = [ShownScorer(store[i]) for i in chosen]
        for m, method in enumerate(methods):
            match = match_step(errors[:, m], batch.valid)[:, None]
            times = batch.times.gather(1, match)
            copied = errors[:, 1:].amin(1).gather(1, match)[:, 0].cpu().numpy()
            row = [errors[:, m].gather(1, match), times, times / batch.end,
                   _changed_l1(images[:, m], batch, match[:, 0], measured)[:, None]]
            pictures = ((images[:, m] + 1) / 2).movedim(1, -1).cpu().numpy()
            shown = [scorer.score(picture, int(time)) for scorer, picture, time in zip(
                scorers, pictures, times[:, 0].tolist())]
            parts[method].append([*(part[:, 0].cpu().numpy() for part in row), placed[:, m],
                                  mass[:, m], *np.array(shown).T, copied])
    return {method: EpisodeScores(*(np.concatenate(column) for column in zip(*rows)))
            for method, rows in parts.items()}


def _is_forward(network: PredictorNetwork | Predictor) -> bool:
    return network.config.num_context == 1 if isinstance(network, torch.nn.Module) else (
        network.mode == 'forward')


def _ask_network(network: PredictorNetwork, batch: Batch,
                 episodes: Sequence[int] | np.ndarray) -> tuple[torch.Tensor, MapsOf]:
    """Return the pictures (B, 3, H, W) of a network, and its maps, see score_bottlenecks."""
    z, size = None, network.config.latent_size
    if size:
        z = draw_latents(episodes, 1, size)[:, 0].to(batch.context.device)
    prediction = network(to_float(batch.context), z)
    return prediction.image, lambda b, pixels: predicted_maps(pixels, prediction, b)


def _ask(predictor: Predictor, batch: Batch) -> tuple[torch.Tensor, MapsOf]:
    """Return what another predictor shows, as _ask_network."""
    def ask(b: int, pixels: np.ndarray) -> Subgoal:
        names = ('start', 'goal')[:batch.context.shape[1]]
        return predictor.predict_together([Question(
            **dict(zip(names, batch.context[b].numpy())),
            **{f'{name}_pixels': at for name, at in zip(names, pixels)})])[0][0]

    def maps_of(b: int, pixels: np.ndarray) -> WarpedMaps:
        subgoal = ask(b, pixels)
        return WarpedMaps(torch.from_numpy(subgoal.object_maps), torch.from_numpy(subgoal.mass))

    nothing = np.zeros((2, 0, 2), np.float32)
    images = [ask(b, nothing).image for b in range(len(batch.context))]
    return to_float(np.stack(images)), maps_of


def _changed_l1(images: torch.Tensor, batch: Batch, match: torch.Tensor,
                context: torch.Tensor) -> torch.Tensor:
    """Measure EpisodeScores.changed_l1 of pictures (B, 3, H, W); return (B,)."""
    targets = to_float(batch.targets[torch.arange(len(match)), match])
    changed = changed_pixels(targets, context)  # B, 1, H, W
    error = ((images - targets).abs().mean(1, keepdim=True) / 2 * changed).sum((1, 2, 3))
    return error / changed.sum((1, 2, 3))  # 0 / 0 is NaN


def write_pictures(path: str | Path, network: PredictorNetwork, store: EpisodeStore,
                   episodes: Sequence[int] | np.ndarray, goal_picture: str = 'last',
                   filled: Filled | None = None) -> None:
    """
    Write a sheet of predictions, a row for each episode.

    Columns: start, goal if there is one, prediction, best matching frame, and for predictions
    without new pixels the same with its object maps.

    :param path: .png file to write.
    :param network: PredictorNetwork in eval mode.
    :param store: the EpisodeStore.
    :param episodes: indices of episodes.
    :param goal_picture: see batches.make_batch.
    :param filled: as in evaluate.
    """
    from matplotlib.image import imsave

    batch = make_batch(store, episodes, Sampling(
        goal_picture=goal_picture, forward=network.config.num_context == 1), filled=filled)
    context = to_float(batch.context).to(next(network.parameters()).device)
    with torch.inference_mode():
        prediction = network(context)
        images = batch.visible(prediction.image[:, None].cpu())
        errors = l1_errors(images, batch.targets.movedim(-1, 2))[:, 0]
    match, images = match_step(errors, batch.valid), to_uint8(prediction.image)
    rows = []
    for b, i in enumerate(episodes):
        row = [*batch.context[b].numpy(), images[b], batch.targets[b, match[b]].numpy()]
        pixels = context_pixels(store[i], goal_picture)
        if pixels.size and np.isfinite(pixels).all() and prediction.new_pixels is None:
            maps = predicted_maps(pixels, prediction, b).maps
            row.append(overlay(images[b], maps.cpu().numpy()))
        rows.append(row)
    imsave(path, grid(rows, 2))


@dataclass(frozen=True)
class Options:
    """
    Options of `python -m tap_ros evaluate prediction`.

    :param recordings: bag folders, folders of bag folders, or .mcap files; read as those of the
        training were.
    :param image_topic: the camera's topic; needed where several topics of pictures are in them.
    :param all: take every episode, not only those that training held out.
    :param goal_picture: the episode's last frame, or the goal's own picture where reached, with
        the arm elsewhere.
    :param samples: how many to draw of weights with z.
    :param marks: file of marks (see `mark`) that the matched frames are compared with.
    :param out: write scores.json and pictures.png there.
    """

    weights: Annotated[str, conf.arg(
        metavar='FILE',
        help=f'of a predictor: a file, or shipped ones: {", ".join(PREDICTORS)}; or another '
             'predictor, such as nearest_keyframe:bags/push2, which then has seen those bags.')]
    recordings: Bags
    image_topic: Topic = ''
    all: Flag = False
    goal_picture: Literal['last', 'recorded'] = 'recorded'
    samples: int = SAMPLES
    marks: File = ''
    out: Folder = ''


def run(args: Options) -> None:
    """
    Score weights, print a table with copying beside them, and write what --out asks for.

    :raises ConfigError: if there is nothing to score, or the pictures have another size.
    """
    network: PredictorNetwork | Predictor
    if predictor_files(args.weights):
        network, training = load_network(args.weights)
        size = network.config.image_size
    else:
        network, training = load_predictor(args.weights), {}
        size = network.image_size[0]
    store = open_recordings(
        args.recordings, reading=reading_like(training, args.recordings, args.image_topic))
    if store.image_size != (size, size):
        raise ConfigError(f'{args.weights}: made for {size} pixels a side, '
                          f'the recordings have {store.image_size}; use matching ones')
    settings = training.get('settings', {})
    robot_mask = trained_robot_mask(training)[0]
    kept, held_out = with_masks(store, split_episodes(
        store, settings.get('test_fraction', TEST_FRACTION),
        held_out=() if args.all else settings.get('held_out', ())), robot_mask)
    episodes = np.sort(np.concatenate([kept, held_out])) if args.all else held_out
    if not len(episodes):
        raise ConfigError('recordings: no episode of them was held out from training; '
                          'give more of them, or --all')
    marks = read_marks(args.marks, store) if args.marks else None
    if marks and not set(marks.episodes) & set(episodes.tolist()):
        raise ConfigError(
            'marks: none of the episodes that are scored is marked; mark some of them, in the '
            f'order of the recordings from 0: {listing(episodes)}; or give --all')
    filled = fill(store, robot_mask)
    scores = evaluate(network, store, episodes, goal_picture=args.goal_picture, filled=filled)
    sources = {(store[i].object_source or 'unknown').replace('_', ' ')
               for i in episodes if store[i].object_names}
    count = f'{len(episodes)} episode{"s" if len(episodes) > 1 else ""}'
    print(f'{count}, goal picture: {args.goal_picture}; l1 on [0, 1]; '
          + ''.join(f'object positions: {source}; ' for source in sorted(sources))
          + 'in brackets 95% intervals over the episodes')
    warn_if_few(episodes)
    _print_table(scores)
    seen = None
    if len(kept) and not args.all and training.get('data_hash') == store.data_hash:
        seen = evaluate(network, store, kept[:len(episodes)], goal_picture=args.goal_picture,
                        filled=filled)['prediction']
    words = verdict(scores['prediction'], seen)
    print('\n'.join(words))
    about: dict[str, Any] = {method: value.summary() | {'intervals': {
        name: interval[1:] for name, interval in value.intervals().items()}}
        for method, value in scores.items()}
    if marks:
        hits = score_hits(store, marks, episodes, scores['prediction'].match_step, training)
        print_hits(hits, len(set(marks.episodes) & set(episodes.tolist())))
        about['marks'] = hits
    if isinstance(network, PredictorNetwork) and network.config.latent_size:
        about['samples'] = _report_samples(score_samples(
            network, store, episodes, goal_picture=args.goal_picture, count=args.samples,
            filled=filled), args.samples)
    if args.out:
        folder = Path(args.out)
        about = {'weights': str(args.weights), 'data_hash': store.data_hash,
                 'goal_picture': args.goal_picture, 'margin': 0, 'verdict': words,
                 'scores': about}
        if robot_mask != 'none':
            about['robot_mask'] = robot_mask
        write_atomically(folder / 'scores.json', json.dumps(about, indent=2) + '\n')
        if isinstance(network, PredictorNetwork):
            write_pictures(folder / 'pictures.png', network, store, episodes[:12],
                           args.goal_picture, filled=filled)


def verdict(held_out: EpisodeScores, training: EpisodeScores | None) -> list[str]:
    """
    Compare predictions with copying the nearer input, both at the matched frame, in words.

    A low error alone says nothing: frames beside an input are predicted well by copying it.

    :param held_out: scores of episodes that were not trained on; training: of some that were.
    :return: lines.
    """
    lines, gains = [], []
    for name, scores in (('held-out episodes', held_out), ('training episodes', training)):
        if scores is None:
            continue
        gain = bootstrap(lambda errors, copied: 1 - errors.mean(-1) / copied.mean(-1),
                         scores.min_l1, scores.copying)
        gains.append(gain)
        words = ('better than copying' if gain.low > 0 else 'worse than copying'
                 if gain.high < 0 else 'not told from copying')
        lines.append(f'{name}, at the matched frame: {words}, error {scores.min_l1.mean():.4f} '
                     f'against {scores.copying.mean():.4f}, lower by {_text(gain)}')
    if len(gains) == 2 and gains[0].low <= 0 < gains[1].low:
        lines.append('memorised: only what it was trained on is predicted better than by copying; '
                     'record more, or train fewer steps')
    return lines


def _print_table(scores: Mapping[str, EpisodeScores]) -> None:
    """Print a line for each metric, a column for each method."""
    columns = {method: value.intervals() for method, value in scores.items()}
    print(f'{"":20s}' + ''.join(f'{method:>28s}' for method in columns))
    for name in _SHOWN:
        if name in columns['prediction']:
            print(f'{name:20s}' + ''.join(
                f'{_text(column[name]) if name in column else "-":>28s}'
                for column in columns.values()))


def _report_samples(samples: SampleScores, count: int) -> dict[str, float]:
    """Print what the samples score; return it as a dict."""
    result: dict[str, float] = {'count': count}
    for name, title in (('min_l1', f'min_l1, best of {count}'), ('spread', 'sample spread'),
                        ('spread_px', 'sample spread, px')):
        values = getattr(samples, name)
        if np.isfinite(values).all():
            interval = mean_interval(values)
            result[name] = interval.value
            print(f'{title:28s}{_text(interval):>20s}')
    return result


def _text(interval: Interval) -> str:
    """Write an Interval."""
    return '{:.4f} ({:.4f}, {:.4f})'.format(*interval)
