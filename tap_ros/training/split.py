# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which episodes a network is trained on, and which it is measured on."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
import warnings
import zlib

import numpy as np
from tap_ros.base.errors import RecordingError, RecordingWarning
from tap_ros.images.robot_mask import RobotMask
from tap_ros.messages.topics import ROBOT_MASK

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

TEST_FRACTION = 0.05  # held out unless a training says otherwise
FEW = 5  # held-out episodes, of which scores say little


def split_episodes(store: 'EpisodeStore', test_fraction: float = TEST_FRACTION,
                   min_frames: int = 3,
                   held_out: Sequence[str | Path] = ()) -> tuple[np.ndarray, np.ndarray]:
    """
    Split episodes into training and held-out ones, by task and seed, or by recording.

    Episodes of the same scene land on the same side, whichever recording they are in. Recordings
    without seeds are split by position, and what several cameras saw of one demonstration stays
    together. Of two scenes or more one is always held out, unless the share is 0.

    :param store: the EpisodeStore.
    :param test_fraction: the held-out share, 0..1.
    :param min_frames: episodes with fewer frames are left out.
    :param held_out: files or folders: what is recorded there is held out, and nothing else.
    :return: (training, held-out), int64 arrays of episode indices.
    :raises RecordingError: if no episode is long enough to train on.
    """
    usable = [i for i in range(len(store)) if store.lengths[i] >= min_frames]
    if not usable:
        begins = np.array([store[i].stamps[0] for i in range(len(store))])
        pauses = np.diff(begins)[np.diff(begins) > 0] / 1e9
        together = '' if store.marked or not len(pauses) else (
            f', or, as there is a picture each {np.median(pauses):.2g} s, keep them together: '
            f'--gap {2 * np.median(pauses):.2g}')
        raise RecordingError(f'recordings: no episode has at least {min_frames} frames; '
                             f'record longer ones{together}')
    chosen = np.array(usable)
    if held_out:
        places = {Path(path).resolve() for path in held_out}
        held = np.array([not places.isdisjoint((file, *file.parents)) for file in (
            store.source(i).resolve() for i in usable)])
        return chosen[~held], chosen[held]
    seeds = [store[i].seed for i in usable]
    keys = ([(store[i].task, seed) for i, seed in zip(usable, seeds)] if len(set(seeds)) > 1
            else _demonstrations(store, usable))
    # A hash rather than a random draw: adding episodes moves none to the other side.
    hashes = np.array([zlib.crc32(repr(key).encode()) for key in keys])
    held = hashes < test_fraction * 2 ** 32
    if test_fraction and not held.any():
        held = hashes == hashes.min()
    if held.all():
        held = hashes != hashes[0]
    return chosen[~held], chosen[held]


def _demonstrations(store: 'EpisodeStore', episodes: Sequence[int]) -> list[int]:
    """Return for each episode the first one of its recording that was seen at the same time."""
    known: dict[Path, list[tuple[int, int, int]]] = {}  # of a recording: from, to, number
    found = []
    for i in episodes:
        begin, end = store.seen(i)
        spans = known.setdefault(store.source(i), [])
        together = [(min(last, end) - max(first, begin), number) for first, last, number in spans]
        longest, number = max(together, default=(-1, i))
        found.append(number if longest >= 0 else i)
        spans.append((begin, end, found[-1]))
    return found


def with_masks(store: 'EpisodeStore', parts: tuple[np.ndarray, np.ndarray],
               robot_mask: RobotMask) -> tuple[np.ndarray, np.ndarray]:
    """
    Leave out the episodes that a robot mask cannot be used with.

    :param parts: int64, indices of the episodes to train on and of those held out.
    :param robot_mask: see robot_mask.hidden_pixels; with 'none' all of them stay.
    :return: the same, with those whose frames all have a mask; a warning says how many have not.
    :raises RecordingError: when none is left to train on.
    """
    if robot_mask == 'none':
        return parts
    training, held_out = (part[[store.has_masks(int(i)) for i in part]] for part in parts)
    before, after = sum(map(len, parts)), len(training) + len(held_out)
    if len(parts[0]) and not len(training):
        raise RecordingError(
            f'recordings: robot_mask {robot_mask} needs a robot mask for every picture of an '
            f'episode, and {len(training)} of {len(parts[0])} to train on have them; record '
            f'{ROBOT_MASK.recorded} beside the camera, or give --robot-mask none')
    if after < before:
        warnings.warn(
            f'recordings: {before - after} of {before} episodes are left out, as not all of their '
            'pictures have a robot mask', RecordingWarning, stacklevel=3)
    return training, held_out


def warn_if_few(held_out: np.ndarray) -> None:
    """Say before a training that few episodes, or none, measure how good it is."""
    if len(held_out) < FEW:
        count = f'{len(held_out)} episode{" is" if len(held_out) == 1 else "s are"}'
        warnings.warn(f'recordings: only {count} held out, and scores of fewer than {FEW} say '
                      'little; record more, give a larger --test-fraction, or --held-out BAG',
                      RecordingWarning, stacklevel=3)
