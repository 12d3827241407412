# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which episodes a network is trained on, and which it is measured on."""

from typing import TYPE_CHECKING
import zlib

import numpy as np
from tap_ros.errors import RecordingError

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

TEST_FRACTION = 0.05  # held out unless a training says otherwise


def split_episodes(store: 'EpisodeStore', test_fraction: float = TEST_FRACTION,
                   min_frames: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """
    Split episodes into training and held-out ones, by task and seed.

    Episodes of the same scene land on the same side, whichever recording they are in.
    Recordings without seeds are split by position.

    :param store: the EpisodeStore.
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
    held = np.array([zlib.crc32(repr(key).encode()) < test_fraction * 2 ** 32 for key in keys])
    usable = np.array(usable)
    if held.all():
        held[0] = False
    return usable[~held], usable[held]
