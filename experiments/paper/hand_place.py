# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure whether the place of the hand at a bottleneck follows from where the objects are.

A small network is told the true positions of the objects and the hand in the first and the last
frame, and which object moves first. It says where the hand is in any one of the bottleneck's
frames: its loss is the least distance over these frames, as genmin's is the least error. A
predictor of pictures is told less. In pushing the bottleneck is where one object is home and the
other one untouched, in gripping where the hand closes around an object at its start.

By its area, a painted hand lowers the l1 error only where it covers more than half of the true
one: what is beside it is wrong twice, where it is painted and where it is left out.
"""

from dataclasses import dataclass
import json
import shlex
import sys

import numpy as np
from sim_bridge.tasks.tasks import TASKS
from sim_bridge.world.scene import GRIPPER, PUSHER
from tap_ros.errors import TapError
from tap_ros.evaluation.intervals import bootstrap
from tap_ros.files import write_atomically
from tap_ros.options import Bags, File, parse
from tap_ros.recording.cache import open_recordings
from tap_ros.training.split import split_episodes
import torch
from torch import nn
from tyro import conf

UNTOUCHED, HOME = 0.01, 0.02  # m
FAR = 100.0  # m, where a hand is that is not there
LEAST = 10  # episodes
STEPS, BATCH, WIDTH, RATE, DECAY = 1000, 128, 128, 1e-3, 1e-2


@dataclass(frozen=True)
class Options:
    """
    Options of `python -m experiments.paper.hand_place`.

    :param bags: recordings, a row each; of one task each, with object positions.
    :param held_out: share of the episodes that it is tested on.
    :param seed: of the network.
    :param out: the file of results.
    """

    bags: conf.Positional[Bags]
    held_out: float = 0.1
    seed: int = 0
    out: File = 'docs/results/hand_place.json'


def bottleneck_hands(episode):
    """
    Find where the hand is in the frames of the bottleneck.

    :param episode: an Episode of a task in TASKS, with object positions.
    :return: the index of the object that moves first, and (n, 2) metres, the hand in n frames;
        None without such frames.
    """
    places = episode.object_poses[:, :, :2]
    from_start, to_end = (np.linalg.norm(places - places[t], axis=-1) for t in (0, -1))  # (T, K)
    untouched = from_start < UNTOUCHED
    if TASKS[episode.task].gripping:
        there = untouched & (episode.actions[:, 3:] < 0.5)  # told to close
    else:
        others = untouched.sum(1, keepdims=True) - untouched
        there = (to_end < HOME) & (others == places.shape[1] - 1)
    there &= from_start[-1] > HOME  # what stays is home and untouched at once
    moving = np.flatnonzero(there.any(0))
    if not len(moving):
        return None
    first = int(moving[0])
    return first, episode.grippers[there[:, first], :2].astype(np.float32)


def known_places(episode, first):
    """Return (4K + 4,) metres: the objects, the one to move first, and the hand, at both ends."""
    order = [first, *(k for k in range(len(episode.object_names)) if k != first)]
    ends = [0, -1]
    return np.concatenate([episode.object_poses[ends][:, order, :2].ravel(),
                           episode.grippers[ends, :2].ravel()]).astype(np.float32)


def distance_to_nearest(hands, places):
    """
    Measure how far places are from the hand in the nearest frame.

    :param hands: (N, T, 2) metres, FAR where an episode has fewer frames.
    :param places: (N, 2) metres.
    :return: (N,) metres.
    """
    return (hands - places[:, None]).square().sum(-1).amin(1).sqrt()


def best_cover(hands, places, half_sizes):
    """
    Measure which share of the hand, seen from above, one at the predicted place covers.

    :param hands: (N, T, 2) metres, FAR where an episode has fewer frames.
    :param places: (N, 2) metres.
    :param half_sizes: (2,) metres, of the hand.
    :return: (N,), 0 to 1, in the frame where it is largest.
    """
    apart = (hands - places[:, None]).abs() / (2 * torch.tensor(half_sizes))
    return (1 - apart).clamp(min=0).prod(-1).amax(1)


def predict_places(known, hands, asked, seed=0):
    """
    Train on episodes and say where the hand is in others.

    :param known: (N, F), see known_places.
    :param hands: (N, T, 2) metres, FAR where an episode has fewer frames.
    :param asked: (M, F), likewise known.
    :param seed: of weights and batches.
    :return: (M, 2) metres.
    """
    rng = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = nn.Sequential(
            nn.Linear(known.shape[1], WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(),
            nn.Linear(WIDTH, 2))
    mean, spread = known.mean(0), known.std(0) + 1e-6
    there = hands[hands[..., 0] < FAR]
    middle, extent = there.mean(0), there.std(0)
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        rows = torch.randint(len(known), (BATCH,), generator=rng)
        places = middle + extent * network((known[rows] - mean) / spread)
        # The root, as the mean of distances is as low between two places as at either of them.
        loss = (distance_to_nearest(hands[rows], places) + 1e-4).sqrt().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        rate.step()
    with torch.inference_mode():
        return middle + extent * network((asked - mean) / spread)


def measure(store, held_out, seed=0):
    """
    Measure how near to the hand the predicted places are.

    :param store: EpisodeStore of one task.
    :param held_out: share of the episodes that it is tested on, see split.split_episodes.
    :param seed: of the network.
    :return: dict of results.
    :raises TapError: for another task or several, and with fewer than ten episodes that show the
        bottleneck on either side.
    """
    tasks = {store[i].task for i in range(len(store))}
    if len(tasks) > 1 or not tasks <= set(TASKS):
        raise TapError(f'a recording has the tasks {sorted(tasks)}: expected one of {list(TASKS)}')
    trained, tested = ([found for i in part if (found := _seen(store[i])) is not None]
                       for part in split_episodes(store, held_out))
    if min(len(trained), len(tested)) < LEAST:
        raise TapError(f'{len(trained)} and {len(tested)} episodes show the bottleneck: expected '
                       f'at least {LEAST} to train on and {LEAST} to test on')
    (known, hands), (asked, there) = map(_stacked, (trained, tested))
    places = predict_places(known, hands, asked, seed)
    task, = tasks
    palm = (GRIPPER if TASKS[task].gripping else PUSHER).palm[:2]
    cover = best_cover(there, places, palm)
    return {'task': task, 'train_episodes': len(trained), 'test_episodes': len(tested),
            'frames_of_the_bottleneck': float(np.median([len(hand) for _, hand in tested])),
            'more_than_half_covered': _interval(lambda x: (x > 0.5).mean(-1), cover),
            'mean_cover': _interval(lambda x: x.mean(-1), cover),
            'median_distance_m': _interval(
                lambda x: np.median(x, -1), distance_to_nearest(there, places))}


def _seen(episode):
    """Return what is known of an episode and where the hand is, or None; tensors."""
    found = bottleneck_hands(episode)
    if found is None:
        return None
    first, hands = found
    return torch.from_numpy(known_places(episode, first)), torch.from_numpy(hands)


def _stacked(episodes):
    known, hands = zip(*episodes)
    return torch.stack(known), nn.utils.rnn.pad_sequence(
        hands, batch_first=True, padding_value=FAR)


def _interval(statistic, values):
    found = bootstrap(statistic, values.numpy())
    return {key: round(float(x), 4) for key, x in zip(('value', 'ci_low', 'ci_high'), found)}


def main():
    """Measure each recording and write the file."""
    try:
        args = parse(Options, sys.argv[1:], 'python -m experiments.paper.hand_place',
                     (__doc__ or '').strip())
        rows = [{'recording': bag} | measure(open_recordings(bag), args.held_out, args.seed)
                for bag in args.bags]
        command = shlex.join(['python', '-m', 'experiments.paper.hand_place', *sys.argv[1:]])
        write_atomically(args.out, json.dumps(
            {'command': command, 'seed': args.seed, 'held_out': args.held_out,
             'recordings': rows}, indent=1) + '\n')
    except TapError as error:
        sys.exit(f'error: {error}')
    for row in rows:
        print(f"{row['recording']}: more than half of the hand is covered in "
              f"{row['more_than_half_covered']['value']:.0%} of {row['test_episodes']} episodes, "
              f"{row['mean_cover']['value']:.0%} of it in the mean")
    print(args.out)


if __name__ == '__main__':
    main()
