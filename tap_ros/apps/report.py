# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the command `python -m tap_ros evaluate prediction` does: score, print, write."""

from collections.abc import Iterable, Mapping
import json
from pathlib import Path
from typing import Any

import numpy as np
from tap_ros.apps.evaluate import Prediction
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.text import listing
from tap_ros.evaluation.intervals import Interval, mean_interval
from tap_ros.evaluation.keyframes import print_hits, score_hits
from tap_ros.evaluation.prediction import EpisodeScores, evaluate, verdict
from tap_ros.evaluation.samples import SampleScores, score_samples
from tap_ros.evaluation.strips import write_strips
from tap_ros.images.crop import trained_crop
from tap_ros.images.robot_mask import RobotMask, trained_robot_mask
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.protocol import load_predictor, Predictor, predictor_files
from tap_ros.recording.bags import find_bags, reading_like
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.marks import read_marks
from tap_ros.training.inpainted import fill, with_masks
from tap_ros.training.split import split_episodes, TEST_FRACTION, warn_if_few

_SHOWN = ('min_l1', 'copying_l1', 'changed_l1', 'match_fraction', 'match_fraction_std',
          'bottleneck_median', 'bottleneck_1px', 'bottleneck_2px', 'visible_bottleneck_2px',
          'bottleneck_5px', 'shows_hand', 'shows_objects', 'shows_both')
_STRIPS = 12  # episodes that are drawn
_SEEN = 20  # of those trained on, so many are scored, or as many as are held out


def run(args: Prediction) -> None:
    """
    Score weights, print a table with copying beside them, and write what --out asks for.

    :raises ConfigError: if there is nothing to score, or the pictures have another size.
    """
    network: PredictorNetwork | Predictor
    if predictor_files(args.weights):
        network, training = load_network(args.weights)
        size = network.config.image_size
        trained = trained_crop(training, (size, size))
    else:
        network, training = load_predictor(args.weights), {}
        size, trained = network.image_size[0], network.camera_crop
    bags = find_bags(args.recordings)
    store = open_recordings(bags, reading=reading_like(
        training, bags, args.image_topic, trained))
    if store.image_size != (size, size):
        raise ConfigError(f'{args.weights}: made for {size} pixels a side, '
                          f'the recordings have {store.image_size}; use matching ones')
    robot_mask = trained_robot_mask(training)[0]
    kept, episodes = _choose(args, store, training, robot_mask)
    marks = read_marks(args.marks, store) if args.marks else None
    if marks and not set(marks.episodes) & set(episodes.tolist()):
        raise ConfigError(
            'marks: none of the episodes that are scored is marked; mark some of them, in the '
            f'order of the recordings from 0: {listing(episodes)}; or give --all')
    filled = fill(store, robot_mask)
    scores = evaluate(network, store, episodes, goal_picture=args.goal_picture, filled=filled)
    sources = {store[i].object_source or 'unknown' for i in episodes if store[i].object_names}
    _print_table(scores, args.goal_picture, sources)
    warn_if_few(episodes)
    seen = None
    if len(kept) and not args.all and training.get('data_hash') == store.data_hash:
        seen = evaluate(network, store, kept[:max(len(episodes), _SEEN)],
                        goal_picture=args.goal_picture, filled=filled)['prediction']
    words = verdict(scores['prediction'], seen)
    if seen is None and not args.all:
        words.append('training episodes: they are not among these recordings, so nothing tells '
                     'whether they were memorised')
    print('\n'.join(words))
    about: dict[str, Any] = {method: value.summary() | {'intervals': {
        name: interval[1:] for name, interval in value.intervals().items()}}
        for method, value in scores.items()}
    if marks:
        hits = score_hits(store, marks, episodes, episodes if args.all else kept,
                          scores['prediction'].match_step, training)
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
        write_strips(folder / 'pictures.png', network, store, episodes[:_STRIPS],
                     args.goal_picture, filled, marks)


def _choose(args: Prediction, store: EpisodeStore, training: Mapping[str, Any],
            robot_mask: RobotMask) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of the episodes that were trained on, and of those to score."""
    settings = training.get('settings', {})
    kept, held_out = with_masks(store, split_episodes(
        store, settings.get('test_fraction', TEST_FRACTION),
        held_out=() if args.all else settings.get('held_out', ())), robot_mask)
    episodes = np.sort(np.concatenate([kept, held_out])) if args.all else held_out
    if not len(episodes):
        raise ConfigError('recordings: no episode of them was held out from training; '
                          'give more of them, or --all')
    return kept, episodes


def _print_table(scores: Mapping[str, EpisodeScores], goal_picture: str,
                 sources: Iterable[str]) -> None:
    """Print what was scored, and a line for each metric, a column for each method."""
    count = len(scores['prediction'].min_l1)
    print(f'{count} episode{"s" if count > 1 else ""}, goal picture: {goal_picture}; l1 on [0, 1];'
          + ''.join(f' object positions: {source.replace("_", " ")};'
                    for source in sorted(sources))
          + ' in brackets 95% intervals over the episodes')
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
