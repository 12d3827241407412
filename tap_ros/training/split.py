# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which episodes a network is trained on, and which it is measured on."""

from typing import TYPE_CHECKING
import warnings
import zlib

import numpy as np
from tap_ros.errors import RecordingError
from tap_ros.recording.episode import RecordingWarning

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

TEST_FRACTION = 0.05  # held out unless a training says otherwise


def split_episodes(store: 'EpisodeStore', test_fraction: float = TEST_FRACTION,
                   min_frames: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """
    Split episodes into training and held-out ones, by task and seed.

    Episodes of the same scene land on the same side, whichever recording they are in.
    Recordings without seeds are split by position. Of two scenes or more one is always held out,
    unless the share is 0.

    :param test_fraction: the held-out share, 0..1.
    :param min_frames: episodes with fewer frames are left out.
    :return: (training, held-out), int64 arrays of episode indices.
    :raises RecordingError: if no episode is long enough to train on.
    """
    usable = [i for i in range(len(store)) if store.lengths[i] >= min_frames]
    if not usable:
        raise RecordingError(f'recordings: no episode has at least {min_frames} frames; '
                             'record longer ones')
    keys = [(store[i].task, store[i].seed) for i in usable]
    if len(set(keys)) == 1:
        keys = usable
    # A hash rather than a random draw: adding episodes moves none to the other side.
    hashes = np.array([zlib.crc32(repr(key).encode()) for key in keys])
    held = hashes < test_fraction * 2 ** 32
    if test_fraction and not held.any():
        held = hashes == hashes.min()
    if held.all():
        held[0] = False
    chosen = np.array(usable)
    return chosen[~held], chosen[held]


def warn_if_none(held_out: np.ndarray) -> None:
    """Say before a training that nothing will be measured, as no episode is held out."""
    if not len(held_out):
        warnings.warn('recordings: no episode is held out, so nothing is measured; record at '
                      'least two, and give a --test-fraction above 0', RecordingWarning,
                      stacklevel=3)
