# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which episodes a network is trained on, and which it is measured on."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
import hashlib
from pathlib import Path
import re
from typing import Any, Literal, TYPE_CHECKING
import warnings
import zlib

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError, RecordingWarning
from tap_ros.base.text import escaped, listing
from tap_ros.images.robot_mask import RobotMask
from tap_ros.messages.topics import ROBOT_MASK
from tap_ros.recording.marks import episodes_in

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

Split = Literal['exact', 'crc32']
TEST_FRACTION = 0.05  # held out unless a training says otherwise
FEW = 5  # held-out episodes, of which scores say little
Parts = tuple[np.ndarray, np.ndarray]  # training, held-out: int64 indices of episodes


def split_episodes(store: 'EpisodeStore', test_fraction: float = TEST_FRACTION,
                   min_frames: int = 3, held_out: Sequence[str | Path] = (),
                   marked: Collection[int] = (), split: Split = 'exact') -> Parts:
    """
    Split episodes into training and held-out ones, by scene, demonstration or recording.

    Episodes of the same task and seed land on the same side, whichever recording they are in; so
    does, without seeds, what several cameras saw of one demonstration. A fixed random order, by a
    hash, says which are held out: where episodes are added, few move to the other side.

    :param store: the EpisodeStore.
    :param test_fraction: the held-out share, 0..1, of the scenes or demonstrations; rounded, but
        at least one and not all of them, unless it is 0.
    :param min_frames: episodes with fewer frames are left out.
    :param held_out: see parse_held_out: what is named is held out, and nothing else.
    :param marked: indices of episodes that are held out only when no others are left.
    :param split: 'exact', or as the shipped weights were split: 'crc32', each by its own hash, so
        that the share is met on average only, and marked ones are held out, too.
    :return: (training, held-out), int64 arrays of episode indices.
    :raises RecordingError: if no episode is long enough to train on.
    :raises ConfigError: for a demonstration that there is not.
    """
    usable = _usable(store, min_frames)
    chosen = np.array(usable)
    if held_out:
        held = np.array(_named(store, usable, held_out))
    elif split == 'crc32':
        hashes = np.array([zlib.crc32(repr(key).encode()) for key in (
            _scenes(store, usable) or _demonstrations(store, usable))])
        held = hashes < test_fraction * 2 ** 32
        if test_fraction and not held.any():
            held = hashes == hashes.min()
        if held.all():
            held = hashes != hashes[0]
    else:
        everything = digests_of(store)
        digests = [everything[i] for i in usable]
        kept = {everything[i] for i in marked}
        order = sorted(set(digests), key=lambda digest: (digest in kept, digest))
        count = min(max(1, round(test_fraction * len(order))), len(order) - 1)
        held = np.isin(digests, order[:count if test_fraction else 0])
    return chosen[~held], chosen[held]


def split_as_trained(store: 'EpisodeStore', training: Mapping[str, Any],
                     test_fraction: float = TEST_FRACTION) -> Parts:
    """
    Split episodes as a training did: what it held out, whatever else the recordings hold.

    :param training: what its weights file tells of it; {} of what was not trained.
    :param test_fraction: of those that do not tell what they held out.
    :return: as split_episodes; held out is what the training did not see.
    """
    settings = training.get('settings', {})
    if 'held_out_digests' in training and not settings.get('held_out'):
        usable = np.array(_usable(store))
        held = np.isin(digests_of(store), training['held_out_digests'])[usable]
        return usable[~held], usable[held]
    return split_episodes(store, test_fraction, held_out=settings.get('held_out', ()),
                          split='crc32' if training else 'exact')


def digests_of(store: 'EpisodeStore') -> list[str]:
    """Return a hash of the scene of each episode, else of when its demonstration was seen."""
    episodes = range(len(store))
    keys: list[Any] = list(_scenes(store, episodes))
    if not keys:
        first, times = _demonstrations(store, episodes), {}
        count: Counter[tuple[int, int]] = Counter()
        for i in dict.fromkeys(first):
            span = store.seen(i)
            times[i] = *span, count[span]  # clocks of several recordings may begin alike
            count[span] += 1
        keys = [times[i] for i in first]
    return [hashlib.sha256(repr(key).encode()).hexdigest()[:16] for key in keys]


def parse_held_out(text: str | Path) -> tuple[Path, list[tuple[int, int]]]:
    """
    Read what --held-out names: a file or folder, or demonstrations of it.

    :param text: bags/mine, or with numbers from 0, as marks have them: bags/mine:7 or
        bags/mine:3,10-19. A path that exists is one, whatever its name.
    :return: the path; of demonstrations (first, last) of each range, none: all.
    """
    path, _, numbers = str(text).rpartition(':')
    if not path or Path(text).exists() or not re.fullmatch(r'\d+(-\d+)?(,\d+(-\d+)?)*', numbers):
        return Path(text), []
    ends = [[int(end) for end in part.split('-')] for part in numbers.split(',')]
    return Path(path), [(both[0], both[-1]) for both in ends]


def describe_split(held_out: np.ndarray, training: np.ndarray, marked: Collection[int]) -> str:
    """Return in words what a training holds out, with its numbers in the order of recordings."""
    count = len(held_out) + len(training)
    unused = len(set(marked) & set(held_out.tolist()))
    marks = f', {unused or "none"} of {len(marked)} marked' if marked else ''
    return f'held out: {len(held_out)} of {count} episodes{marks}: {listing(held_out, 20)}'


def _usable(store: 'EpisodeStore', min_frames: int = 3) -> list[int]:
    """Return the episodes that are long enough; a RecordingError says that there are none."""
    usable = [i for i in range(len(store)) if store.lengths[i] >= min_frames]
    if not usable:
        together = '' if store.marked else ', or give a larger --gap'
        raise RecordingError(f'recordings: no episode has at least {min_frames} frames; '
                             f'record longer ones{together}')
    return usable


def _named(store: 'EpisodeStore', usable: Sequence[int],
           held_out: Iterable[str | Path]) -> list[bool]:
    """Tell of each usable episode whether it is named, or another camera's picture of one."""
    found: set[int] = set()
    for text in held_out:
        path, ranges = parse_held_out(text)
        inside = episodes_in(store, path)
        if not ranges or not inside:
            found |= {*inside}
        for first, last in ranges if inside else ():
            if not first <= last < len(inside):
                raise ConfigError(f'--held-out {escaped(text)}: there is no such demonstration; '
                                  f'expected 0 to {len(inside) - 1}')
            found |= {*inside[first:last + 1]}
    if not any(parse_held_out(text)[1] for text in held_out):
        return [i in found for i in usable]
    together = _demonstrations(store, usable)
    named = {first for i, first in zip(usable, together) if i in found}
    return [first in named for first in together]


def _scenes(store: 'EpisodeStore', episodes: Sequence[int]) -> list[tuple[str, int]]:
    """Return the task and seed of each episode; [] where all seeds are the same."""
    found = [(store[i].task, store[i].seed) for i in episodes]
    return found if len({seed for _, seed in found}) > 1 else []


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
                      'little; record more, or train with a larger --test-fraction or --held-out '
                      'BAG',
                      RecordingWarning, stacklevel=3)
