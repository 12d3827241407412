# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Show what a recording or a weights file holds."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Annotated

import numpy as np
from tap_ros.base.contract import ROBOT_MASK_ARM, ROBOT_MASK_HAND
from tap_ros.base.files import write_atomically
from tap_ros.base.options import File
from tap_ros.base.text import counted, escaped, listing
from tap_ros.images.crop import check_trainable
from tap_ros.images.drawing import film_strip, grid, png_bytes
from tap_ros.recording.bags import find_bags, list_topics
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
from tap_ros.recording.reading import reading_of, ReadingOptions
from tap_ros.training.split import split_episodes, TEST_FRACTION, warn_if_few
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param path: an .mcap file, a bag folder, or a .safetensors file.
    :param picture: write film strips of the first episodes to this PNG.
    :param episodes: episodes in the picture.
    :param robot_mask: tint what the robot masks mark: the arm red, the hand blue.
    :param test_fraction: held-out share of the demonstrations, as of `train`.
    """

    path: Annotated[conf.Positional[str], conf.arg(metavar='PATH')]
    picture: File = ''
    episodes: int = 8
    robot_mask: bool = False
    test_fraction: float = TEST_FRACTION
    reading: ReadingOptions = ReadingOptions()


def run(args: Options) -> None:
    """
    Print a summary; write a picture when asked to.

    :raises TapError: for what cannot be read, and for a recording that `train` would refuse.
    """
    if Path(args.path).suffix == '.safetensors':
        from tap_ros.prediction.keyframe_bank import KeyframeBank  # torch takes seconds
        from tap_ros.weights.weights import load_tensors
        tensors, about = load_tensors(args.path)
        if bank := KeyframeBank.take(tensors, args.path):
            about['recorded_pictures'] = len(bank.keyframes)  # of demonstrations, to be copied
        print(json.dumps(about, indent=2))
        return
    bags = find_bags(args.path)
    for number, (topic, kind, count) in enumerate(list_topics(bags)):
        print(f'{"" if number else "topics":<11} {escaped(topic)}  {escaped(kind)}  '
              + ('unknown' if count is None else f'{count} messages'))
    reading = reading_of(args.reading)
    store = open_recordings(bags, reading=reading, network='the predictor')
    episodes = [store[i] for i in range(len(store))]
    lengths = np.array([len(e.frames) for e in episodes])
    print(f'{escaped(args.path)}: {counted(len(episodes), "episode")}, {lengths.sum()} frames of '
          f'{store.image_size[1]}x{store.image_size[0]} pixels')
    if store.camera_size not in (store.image_size, None):
        print('cut         from pictures of {1}x{0} pixels'.format(*store.camera_size))
    apart = 'by marks' if store.marked else (
        f'no marks: by pauses of more than {reading.gap:g} s (--gap); a bag alone without any is '
        f'cut into parts of at most {reading.episode_seconds:g} s (--episode-seconds)')
    masked = sum(e.robot_masks is not None for e in episodes)
    for name, value in (
            ('told apart', apart), ('camera', listing(store.cameras)),
            ('length', f'{lengths.min()} to {lengths.max()} frames, median '
                       f'{np.median(lengths):g}'),
            ('objects', listing(sorted({len(e.object_names) for e in episodes}))),
            ('commands', listing(store.commands) or 'none'),
            ('signals', listing(sorted({name for e in episodes for name in e.signal_names}))
             or 'none'),
            ('robot masks', f'{masked} of {len(episodes)} episodes'),
            ('task', _counted(e.task for e in episodes)),
            ('outcome', _counted(e.outcome for e in episodes)), ('data hash', store.data_hash)):
        print(f'{name:<11} {value}')
    if args.picture:
        strips = [film_strip(_tinted(e) if args.robot_mask else e.frames)
                  for e in episodes[:args.episodes]]
        write_atomically(args.picture, png_bytes(grid(strips, scale=2)))
        print(f'picture     {escaped(args.picture)}')
    check_trainable(store.image_size, 'the predictor')
    training, held_out = split_episodes(store, args.test_fraction)
    print(f'train       {counted(len(training), "episode")} to learn from, {len(held_out)} held '
          'out')
    warn_if_few(held_out)


def _counted(values: Iterable[str]) -> str:
    return listing(f'{escaped(value, 40) or "unknown"} {count}'
                   for value, count in Counter(values).most_common())


def _tinted(episode: Episode) -> np.ndarray:
    """Return the frames (T, H, W, 3) of an episode with the robot tinted, where it has masks."""
    frames = episode.frames.copy()
    if episode.robot_masks is not None:
        for label, channel in ((ROBOT_MASK_ARM, 0), (ROBOT_MASK_HAND, 2)):
            marked = episode.robot_masks == label
            frames[marked] //= 2
            frames[marked, channel] += 127
    return frames
