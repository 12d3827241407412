# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Show what a recording or a weights file holds."""

from collections import Counter
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Annotated

import numpy as np
from tap_ros.contract import ROBOT_MASK_ARM, ROBOT_MASK_HAND
from tap_ros.files import write_atomically
from tap_ros.options import File, Topic
from tap_ros.pictures import film_strip, grid, png_bytes
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.episode import Episode
from tap_ros.text import escaped, listing
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param path: an .mcap file, a bag folder, or a .safetensors file.
    :param picture: write film strips of the first episodes to this PNG.
    :param episodes: episodes in the picture.
    :param robot_mask: tint what the robot masks mark: the arm red, the hand blue.
    :param image_topic: the camera's topic; needed where several topics of pictures are in it.
    """

    path: Annotated[conf.Positional[str], conf.arg(metavar='PATH')]
    picture: File = ''
    episodes: int = 8
    robot_mask: bool = False
    image_topic: Topic = ''


def run(args: Options) -> None:
    """Print a summary; write a picture when asked to."""
    if Path(args.path).suffix == '.safetensors':
        from tap_ros.learning.weights import load_tensors  # torch takes seconds
        _, about = load_tensors(args.path)
        print(json.dumps(about, indent=2))
        return
    store = open_recordings([args.path], image_topic=args.image_topic)
    episodes = [store[i] for i in range(len(store))]
    lengths = np.array([len(e.frames) for e in episodes])
    objects = sorted({len(e.object_names) for e in episodes})
    print(f'{escaped(args.path)}: {len(episodes)} episodes, {lengths.sum()} frames of '
          f'{store.image_size[1]}x{store.image_size[0]} pixels')
    print(f'length      {lengths.min()} to {lengths.max()} frames, median {np.median(lengths):g}')
    print(f'objects     {", ".join(map(str, objects))}')
    masked = sum(e.robot_masks is not None for e in episodes)
    print(f'robot masks {masked} of {len(episodes)} episodes')
    for name, values in (('task', [e.task for e in episodes]),
                         ('outcome', [e.outcome for e in episodes])):
        counts = Counter(values).most_common()
        counts = listing(f'{escaped(k, 40) or "unknown"} {v}' for k, v in counts)
        print(f'{name:<11} {counts}')
    print(f'data hash   {store.data_hash}')
    if args.picture:
        strips = [film_strip(_tinted(e) if args.robot_mask else e.frames)
                  for e in episodes[:args.episodes]]
        write_atomically(args.picture, png_bytes(grid(strips, scale=2)))
        print(f'picture     {escaped(args.picture)}')


def _tinted(episode: Episode) -> np.ndarray:
    """Return the frames (T, H, W, 3) of an episode with the robot tinted, where it has masks."""
    frames = episode.frames.copy()
    if episode.robot_masks is not None:
        for label, channel in ((ROBOT_MASK_ARM, 0), (ROBOT_MASK_HAND, 2)):
            marked = episode.robot_masks == label
            frames[marked] //= 2
            frames[marked, channel] += 127
    return frames
