# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How good predictions are: the paper's metrics on held-out episodes (section 4, appendix E).

All errors are per-pixel means of the absolute difference on [0, 1]. Copying the start or the goal
picture goes through the same measurement: a low error alone proves nothing.
"""

from dataclasses import dataclass
import json
from pathlib import Path

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.images import to_float, to_uint8
from tap_ros.pictures import grid, overlay
from tap_ros.prediction.batches import make_batch, split_episodes, uses_recorded_goal
from tap_ros.prediction.losses import l1_errors, match_step
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.warp import one_hot_maps, warp_object_maps
from tap_ros.recording.cache import open_recordings
import torch

METHODS = ('prediction', 'copy_start', 'copy_goal')
THRESHOLDS = tuple(range(11))  # px
# An object that hardly moves is at its start and its goal at once: a bottleneck for free.
MIN_MOTION = 4.0  # px
_BATCH = 64


@dataclass(frozen=True)
class EpisodeScores:
    """
    Measurements of N episodes.

    :param min_l1: (N,), error against the best matching frame between start and goal.
    :param match_step: (N,), the time of that frame; the start picture is time 0.
    :param match_fraction: (N,), that time as a share of the episode.
    :param bottleneck: (N,), the score of bottleneck_scores in pixels; NaN where it is undefined.
    """

    min_l1: np.ndarray
    match_step: np.ndarray
    match_fraction: np.ndarray
    bottleneck: np.ndarray

    def summary(self):
        """
        Average over the episodes.

        :return: dict of numbers; bottleneck_<n>px is the share of episodes with a score of at
            most n pixels, among the bottleneck_episodes where it is defined.
        """
        result = {
            'episodes': len(self.min_l1),
            'min_l1': float(self.min_l1.mean()),
            'match_step': float(self.match_step.mean()),
            'match_step_std': float(self.match_step.std()),
            'match_fraction': float(self.match_fraction.mean()),
            'match_fraction_std': float(self.match_fraction.std())}
        scores = self.bottleneck[np.isfinite(self.bottleneck)]
        result['bottleneck_episodes'] = len(scores)
        if len(scores):
            result['bottleneck_median'] = float(np.median(scores))
            for threshold, share in zip(THRESHOLDS, bottleneck_frequency(scores)):
                result[f'bottleneck_{threshold}px'] = float(share)
        return result


def evaluate(network, store, episodes, margin=0, goal_picture='last'):
    """
    Measure a predictor, and copying, on episodes it was not trained on.

    Object positions come from the recordings, that is, from the simulator's ground truth; they
    are used to score only.

    :param network: Predictor in eval mode.
    :param store: the EpisodeStore.
    :param episodes: indices of at least one episode, each of at least 3 frames.
    :param margin: frames beside the context pictures that do not count as matches.
    :param goal_picture: see batches.make_batch.
    :return: dict from METHODS to EpisodeScores.
    """
    device = next(network.parameters()).device
    parts = {method: [] for method in METHODS}
    for at in range(0, len(episodes), _BATCH):
        chosen = episodes[at:at + _BATCH]
        batch = make_batch(store, chosen, margin, goal_picture=goal_picture).to(device)
        context = to_float(batch.context)
        with torch.inference_mode():
            prediction = network(context)
            images = torch.cat([prediction.image[:, None], context], 1)  # B, 3, 3, H, W
            errors = l1_errors(images, batch.targets.movedim(-1, 2))     # B, 3, T
            placed = _bottlenecks(store, chosen, prediction, goal_picture)             # B, 3
        for m, method in enumerate(METHODS):
            match = match_step(errors[:, m], batch.valid)[:, None]
            times = batch.times.gather(1, match)
            row = [errors[:, m].gather(1, match), times, times / batch.end]
            parts[method].append([*(part[:, 0].cpu().numpy() for part in row), placed[:, m]])
    return {method: EpisodeScores(*(np.concatenate(column) for column in zip(*rows)))
            for method, rows in parts.items()}


def evaluate_network(network, store, episodes):
    """
    Measure a network while it is trained: `score` of prediction.training.train.

    :param network: Predictor in eval mode.
    :param store: the EpisodeStore.
    :param episodes: indices of held-out episodes.
    :return: flat dict of the numbers to watch.
    """
    scores = {method: value.summary() for method, value in
              evaluate(network, store, episodes).items()}
    result = scores['prediction']
    for method in METHODS[1:]:
        for name in ('min_l1', 'bottleneck_2px'):
            if name in scores[method]:
                result[f'{method}_{name}'] = scores[method][name]
    return result


def expected_distances(maps, pixels):
    """
    Compute the expected distance between an object under a map and a position.

    :param maps: (..., H, W), each sums to 1.
    :param pixels: (..., 2), (u, v).
    :return: (...), in pixels.
    """
    H, W = maps.shape[-2:]
    u = torch.arange(W, device=maps.device) - pixels[..., 0, None, None]
    v = torch.arange(H, device=maps.device)[:, None] - pixels[..., 1, None, None]
    return (maps * torch.sqrt(u ** 2 + v ** 2)).sum((-2, -1))


def bottleneck_scores(maps, start_pixels, goal_pixels):
    """
    Score how near a prediction is to one object at its goal and the other at its start.

    Appendix E: the smaller one of two hypotheses, which object moves first; each is the sum over
    both objects of the expected distance.

    :param maps: (B, 2, H, W), object maps of the predictions.
    :param start_pixels: (B, 2, 2), (u, v) of both objects in the start picture.
    :param goal_pixels: (B, 2, 2), in the goal picture.
    :return: (B,), in pixels.
    """
    to_start = expected_distances(maps, start_pixels)  # B, 2
    to_goal = expected_distances(maps, goal_pixels)
    first = to_goal[:, 0] + to_start[:, 1]
    second = to_start[:, 0] + to_goal[:, 1]
    return torch.minimum(first, second)


def bottleneck_frequency(scores, thresholds=THRESHOLDS):
    """
    Compute which share of predictions is a bottleneck, for each threshold.

    :param scores: (N,), in pixels.
    :param thresholds: in pixels.
    :return: (len(thresholds),), from 0 to 1.
    """
    return (np.asarray(scores)[:, None] <= np.asarray(thresholds)).mean(0)


def write_pictures(path, network, store, episodes, goal_picture='last', scale=2):
    """
    Write a sheet of predictions, a row for each episode.

    Columns: start, goal, prediction, best matching frame, prediction with its object maps.

    :param path: .png file to write.
    :param network: Predictor in eval mode.
    :param store: the EpisodeStore.
    :param episodes: indices of episodes.
    :param goal_picture: see batches.make_batch.
    :param scale: whole number of times to enlarge each pixel.
    """
    from matplotlib.image import imsave

    batch = make_batch(store, episodes, goal_picture=goal_picture)
    context = to_float(batch.context).to(next(network.parameters()).device)
    with torch.inference_mode():
        prediction = network(context)
        errors = l1_errors(prediction.image[:, None].cpu(), batch.targets.movedim(-1, 2))[:, 0]
    match, images = match_step(errors, batch.valid), to_uint8(prediction.image)
    rows = []
    for b, i in enumerate(episodes):
        row = [*batch.context[b].numpy(), images[b], batch.targets[b, match[b]].numpy()]
        pixels = _context_pixels(store[i], goal_picture)
        if len(pixels[0]) and np.isfinite(pixels).all():
            maps = _object_maps(pixels[None], prediction.flow[b:b + 1], prediction.masks[b:b + 1])
            row.append(overlay(images[b], maps[0].cpu().numpy()))
        rows.append(row)
    imsave(path, grid(rows, scale))


def add_arguments(parser):
    """Add the options of `python -m tap_ros evaluate prediction` to a parser."""
    parser.add_argument('--weights', required=True, metavar='FILE', help='of a predictor')
    parser.add_argument('--recordings', nargs='+', required=True, metavar='BAG',
                        help='bag folders, folders of bag folders, or .mcap files')
    parser.add_argument('--all', action='store_true',
                        help='take every episode, not only those that training held out')
    parser.add_argument('--goal-picture', choices=('last', 'recorded'), default='recorded',
                        help="the episode's last frame, or the goal's own picture where reached, "
                        'with the arm elsewhere (default: %(default)s)')
    parser.add_argument('--margin', type=int, default=0,
                        help='frames beside the context that do not count as matches')
    parser.add_argument('--out', metavar='FOLDER', help='write scores.json and pictures.png there')


def run(args):
    """
    Score weights, print a table with copying beside them, and write what --out asks for.

    :raises ConfigError: if there is nothing to score, or the pictures have another size.
    """
    network, training = load_network(args.weights)
    store = open_recordings(args.recordings)
    if store.image_size != (network.config.image_size,) * 2:
        raise ConfigError(f'{args.weights}: made for {network.config.image_size} pixels a side, '
                          f'the recordings have {store.image_size}; use matching ones')
    fraction = training.get('settings', {}).get('test_fraction', 0.05)
    kept, held_out = split_episodes(store, fraction)
    episodes = np.sort(np.concatenate([kept, held_out])) if args.all else held_out
    if not len(episodes):
        raise ConfigError('recordings: no episode of them was held out from training; '
                          'give more of them, or --all')
    scores = {method: value.summary() for method, value in
              evaluate(network, store, episodes, args.margin, args.goal_picture).items()}
    columns = ('min_l1', 'match_fraction', 'match_fraction_std', 'bottleneck_median',
               'bottleneck_1px', 'bottleneck_2px', 'bottleneck_5px')
    print(f'{len(episodes)} episodes, goal picture: {args.goal_picture}; l1 on [0, 1]; '
          'object positions: ground truth')
    print(f'{"":12s}' + ''.join(f'{name:>20s}' for name in columns))
    for method, row in scores.items():
        print(f'{method:12s}' + ''.join(f'{row.get(name, np.nan):20.4f}' for name in columns))
    if args.out:
        folder = Path(args.out)
        folder.mkdir(parents=True, exist_ok=True)
        about = {'weights': str(args.weights), 'data_hash': store.data_hash,
                 'goal_picture': args.goal_picture, 'margin': args.margin, 'scores': scores}
        (folder / 'scores.json').write_text(json.dumps(about, indent=2) + '\n')
        write_pictures(folder / 'pictures.png', network, store, episodes[:12], args.goal_picture)


def _context_pixels(episode, goal_picture):
    """Return object positions in the start and the goal picture, float32 (2, K, 2)."""
    goal = episode.object_pixels[-1]
    if uses_recorded_goal(episode, goal_picture):
        goal = episode.goal_pixels
    return np.stack([episode.object_pixels[0], goal]).astype(np.float32)


def _object_maps(pixels, flow, masks):
    """Warp one-hot maps at pixels (B, 2, K, 2); return (B, K, H, W)."""
    maps = one_hot_maps(torch.from_numpy(pixels).to(flow.device), flow.shape[-2:])
    return warp_object_maps(maps, flow, masks).maps


def _bottlenecks(store, episodes, prediction, goal_picture):
    """Score the prediction, copy-start and copy-goal of each episode; (B, 3), NaN: undefined."""
    result = np.full((len(episodes), len(METHODS)), np.nan, np.float32)
    size = prediction.flow.shape[-2:]
    for b, i in enumerate(episodes):
        pixels = _context_pixels(store[i], goal_picture)
        if pixels.shape[1] != 2 or not np.isfinite(pixels).all():
            continue
        if np.linalg.norm(pixels[1] - pixels[0], axis=-1).min() < MIN_MOTION:
            continue
        maps = _object_maps(pixels[None], prediction.flow[b:b + 1], prediction.masks[b:b + 1])
        pixels = torch.from_numpy(pixels).to(maps.device)
        maps = torch.cat([maps, one_hot_maps(pixels, size)])  # prediction, start, goal
        result[b] = bottleneck_scores(maps, pixels[:1], pixels[1:]).cpu().numpy()
    return result
