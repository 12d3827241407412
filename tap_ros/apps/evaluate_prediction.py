# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros evaluate prediction`: score, print, write."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import Bags, File, Flag, Folder, Topic
from tap_ros.base.text import counted, listing
from tap_ros.evaluation.full_size import Answer, answer_at_full_size
from tap_ros.evaluation.hits import score_hits, seconds_off
from tap_ros.evaluation.intervals import against_copying, Interval, mean_interval, share_interval
from tap_ros.evaluation.prediction import EpisodeScores, evaluate, verdict
from tap_ros.evaluation.samples import SAMPLES, SampleScores, score_samples
from tap_ros.evaluation.strips import draw_strips
from tap_ros.images.crop import trained_crop, TrainedCrop
from tap_ros.images.drawing import png_bytes
from tap_ros.images.robot_mask import RobotMask, trained_robot_mask
from tap_ros.prediction.networks import PredictorNetwork
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.protocol import load_predictor, Predictor, predictor_files
from tap_ros.recording.bags import find_bags, reading_like
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.marks import Marks, read_marks
from tap_ros.recording.reading import Reading
from tap_ros.training.frames import FilledStore
from tap_ros.training.split import split_as_trained, TEST_FRACTION, warn_if_few, with_masks
from tap_ros.weights import PREDICTORS
from tyro import conf

_SHOWN = ('min_l1', 'copying_l1', 'changed_l1', 'match_fraction', 'match_fraction_std',
          'bottleneck_median', 'bottleneck_1px', 'bottleneck_2px', 'visible_bottleneck_2px',
          'bottleneck_5px', 'shows_hand', 'shows_objects', 'shows_both')
WITHIN_S = (0.3, 0.5, 1.0)  # of a mark
_STRIPS = 12  # episodes that are drawn
_LARGE = 100  # episodes, at most, that are scored at the camera's size
_SEEN = 20  # of those trained on, so many are scored, or as many as are held out


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

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
             'predictor, such as nearest_keyframe:bags/push2.')]
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
    network, training, crop = _load(args.weights)
    store, reading = _open(args, training, crop)
    robot_mask = trained_robot_mask(training)[0]
    learned, episodes = _split(store, training, args.all, robot_mask)
    marks = _read_marks(args.marks, store, episodes, training)
    filled = None if robot_mask == 'none' else FilledStore(store, robot_mask)

    scores = evaluate(network, store, episodes, args.goal_picture, filled,
                      marks.episodes if marks else {})
    _print_table(scores, args.goal_picture, {
        store[i].object_source or 'unknown' for i in episodes if store[i].object_names})
    warn_if_few(episodes)

    seen = None
    if len(learned) and training.get('data_hash') == store.data_hash:
        seen = evaluate(network, store, learned[:max(len(episodes), _SEEN)], args.goal_picture,
                        filled)['prediction']
    words = verdict(scores['prediction'], seen, *(
        ['all episodes, also those trained on'] if args.all else
        [] if training else ['scored episodes']))
    if seen is None and training and not args.all:
        words.append('training episodes: they are not among these recordings, so nothing tells '
                     'whether they were memorised')
    print('\n'.join(words))

    answers = []
    if filled is None and _goals_are_frames(args, store, episodes):
        answers = _answer_large(network, training, store, episodes, reading.crop,
                                scores['prediction'])
    about: dict[str, Any] = {method: value.summary() | {'intervals': {
        name: interval[1:] for name, interval in value.intervals().items()}}
        for method, value in scores.items()}
    if answers:
        about['full_size'] = {name: [getattr(one, name) for one in answers]
                              for name in ('l1', 'copying')}
    if marks:
        about['marks'] = _score_marks(store, episodes, marks, scores['prediction'])
    if isinstance(network, PredictorNetwork) and network.config.latent_size:
        about['samples'] = _summarize(args.samples, score_samples(
            network, store, episodes, args.goal_picture, args.samples, filled))
    if args.out:
        result = {'weights': str(args.weights), 'data_hash': store.data_hash,
                  'goal_picture': args.goal_picture, 'margin': 0, 'verdict': words,
                  'scores': about}
        if robot_mask != 'none':
            result['robot_mask'] = robot_mask
        write_atomically(Path(args.out, 'scores.json'), json.dumps(result, indent=2) + '\n')
        write_atomically(Path(args.out, 'pictures.png'), png_bytes(draw_strips(
            network, store, episodes[:_STRIPS], args.goal_picture, filled, marks,
            [one.pictures for one in answers])))


def _load(weights: str) -> tuple[PredictorNetwork | Predictor, dict[str, Any], TrainedCrop]:
    """Return a predictor, what is known of its training, and the cut of its pictures."""
    if not predictor_files(weights):
        predictor = load_predictor(weights)
        return predictor, {}, predictor.camera_crop
    network, training = load_network(weights)
    return network, training, trained_crop(training, (network.config.image_size,) * 2)


def _open(args: Options, training: dict[str, Any],
          crop: TrainedCrop) -> tuple[EpisodeStore, Reading]:
    """Return the recordings, read as those of the training were, and how."""
    bags = find_bags(args.recordings)
    reading = reading_like(training, bags, args.image_topic, crop)
    store = open_recordings(bags, reading=reading)
    if store.image_size != crop.size:
        raise ConfigError('{0}: made for {2}x{1} pixels (width x height), the recordings have '
                          '{4}x{3}; use matching ones'.format(
                              args.weights, *crop.size, *store.image_size))
    return store, reading


def _split(store: EpisodeStore, training: dict[str, Any], everything: bool,
           robot_mask: RobotMask) -> tuple[np.ndarray, np.ndarray]:
    """Return which episodes were learned from, and which are scored: the others, or all."""
    learned, episodes = with_masks(store, split_as_trained(
        store, {} if everything else training,
        training.get('settings', {}).get('test_fraction', TEST_FRACTION)), robot_mask)
    if everything:
        learned, episodes = learned[:0], np.sort(np.concatenate([learned, episodes]))
    if not len(episodes):
        raise ConfigError('recordings: no episode of them was held out from training; '
                          'give more of them, or --all')
    return learned, episodes


def _read_marks(path: str, store: EpisodeStore, episodes: np.ndarray,
                training: dict[str, Any]) -> Marks | None:
    """
    Return the marks of a file, without labels, of some of these episodes; None without a file.

    :return: of weights that were trained on the marks of one name, those alone.
    """
    marks = read_marks(path, store) if path else None
    if marks:
        marks = replace(marks, episodes=marks.marked)
    if marks and (name := training.get('settings', {}).get('mark_name')):
        marks = marks.named(name)
    if marks and marks.episodes.keys().isdisjoint(episodes.tolist()):
        raise ConfigError(
            'marks: none of the episodes that are scored is marked; mark some of them now, after '
            f'the training, in the order of the recordings from 0: {listing(episodes)}; --all '
            'also scores those that were trained on')
    return marks


def _goals_are_frames(args: Options, store: EpisodeStore, episodes: np.ndarray) -> bool:
    """Return whether no goal is a picture of its own, which is kept at the network's size."""
    return args.goal_picture == 'last' or all(store[i].goal_frame is None for i in episodes)


def _answer_large(network: PredictorNetwork | Predictor, training: dict[str, Any],
                  store: EpisodeStore, episodes: np.ndarray, crop: str,
                  scores: EpisodeScores) -> list[Answer]:
    """
    Return answers to pictures as they were recorded, and print how good they are.

    :return: none where these are not larger, and of weights with z.
    """
    if isinstance(network, PredictorNetwork):
        if network.config.latent_size:
            return []
        network = SubgoalPredictor(network, training)
    answers = answer_at_full_size(network, store, episodes[:_LARGE], scores.match_step[:_LARGE],
                                  crop)
    if answers:
        word, ratio = against_copying(*(np.array([getattr(one, name) for one in answers])
                                        for name in ('l1', 'copying')))
        height, width = answers[0].pictures[0].shape[:2]
        print(f'at {width}x{height} pixels, {counted(len(answers), "episode")}: {word}; error '
              f'{np.mean([one.l1 for one in answers]):.4f}, {ratio.value:.2f} times copying '
              f'({ratio.low:.2f}, {ratio.high:.2f})')
    return answers


def _summarize(count: int, drawn: SampleScores) -> dict[str, Any]:
    """Print and return the means of what was drawn, where that is known."""
    about: dict[str, Any] = {'count': count}
    for name, title in (('min_l1', f'min_l1, best of {count}'), ('spread', 'sample spread'),
                        ('spread_px', 'sample spread, px')):
        values = getattr(drawn, name)
        if np.isfinite(values).all():
            interval = mean_interval(values)
            about[name] = interval.value
            print(f'{title:28s}{_text(interval):>20s}')
    return about


def _score_marks(store: EpisodeStore, episodes: np.ndarray, marks: Marks,
                 scores: EpisodeScores) -> dict[str, Any]:
    """Print and return how often the moment of predictions is right, and the errors at marks."""
    marked = [n for n, i in enumerate(episodes.tolist()) if i in marks.episodes]
    chosen, matched = episodes[marked].tolist(), scores.match_step[marked]
    known = [marks.episodes[i] for i in chosen]
    found = score_hits(known, store.lengths[chosen], matched)
    print(f'the matched frame is a marked one, or within one frame of it, in {len(marked)} marked '
          'episodes:')
    for name, hits in found.items():
        print(f'{name:22s}' + ''.join(f'{_percent(one):>20s}' for one in hits))
    off = seconds_off(known, [store[i].stamps for i in chosen], matched)
    within = [share_interval(off <= s + 1e-6) for s in WITHIN_S]
    word, ratio = against_copying(scores.at_mark[marked], scores.copying_at_mark[marked])
    print(f'the matched frame is within {", ".join(f"{s:g}" for s in WITHIN_S)} s of a mark: '
          f'{", ".join(map(_percent, within))}\nerror at the mark: {word}; {ratio.value:.2f} '
          f'times copying there ({ratio.low:.2f}, {ratio.high:.2f})')
    return {**found, 'seconds': within, 'error': ratio}


def _print_table(scores: Mapping[str, EpisodeScores], goal_picture: str,
                 sources: Iterable[str]) -> None:
    """Print what was scored, and a line for each metric, a column for each method."""
    count = len(scores['prediction'].min_l1)
    print(f'{counted(count, "episode")}, goal picture: {goal_picture}; l1 on [0, 1];'
          + ''.join(f' object positions: {source.replace("_", " ")};'
                    for source in sorted(sources))
          + ' in brackets 95% intervals over the episodes')
    columns = {method: value.intervals() for method, value in scores.items()}
    width = max(map(len, _SHOWN))
    print(' ' * width + ''.join(f'{method:>27s}' for method in columns))
    for name in _SHOWN:
        if name in columns['prediction']:
            print(f'{name:{width}s}' + ''.join(
                f'{_text(column[name]) if name in column else "-":>27s}'
                for column in columns.values()))


def _percent(share: Interval) -> str:
    return f'{share.value:.0%} ({share.low:.0%}, {share.high:.0%})'


def _text(interval: Interval) -> str:
    return '{:.4f} ({:.4f}, {:.4f})'.format(*interval)
