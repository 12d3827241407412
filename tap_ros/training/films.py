# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All that was recorded of a demonstration, by several cameras and as signals, as one Film."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import listing
from tap_ros.training.labels import AROUND_S, Film, film_of

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore


def film_together(store: 'EpisodeStore', i: int, beside: Sequence['EpisodeStore'],
                  signals: Sequence[str]) -> Film | None:
    """
    Describe a demonstration; None for one that is too short.

    :param store: of the first camera, whose frames may be labels.
    :param beside: of other cameras.
    :param signals: names of those that count; their values at the times AROUND_S are columns.
    :raises ConfigError: for a demonstration that another camera did not see, or without a signal.
    """
    first = film_of(store, i)
    if first is None:
        return None
    plain, grey = [first.features[:, :-first.grey]], [first.features[:, -first.grey:]]
    around = [first.around[:-first.grey]]
    for other in beside:
        j = _seen_by(other, store.seen(i))
        one = None if j is None else film_of(other, j)
        if j is None or one is None:
            raise ConfigError(f'{listing(other.cameras)}: has too few pictures of demonstration '
                              f'{i}; leave this camera out')
        times = one.stamps + (other.seen(j)[0] - store.seen(i)[0]) / 1e9
        rows = np.abs(first.stamps[:, None] - times).argmin(1)
        plain.append(one.features[rows, :-one.grey])
        grey.append(one.features[rows, -one.grey:])
        around.append(one.around[:-one.grey])
    episode, seconds = store[i], store.seconds(i)
    for name in signals:
        values = (np.full(len(seconds), np.nan)
                  if episode.signals is None or name not in episode.signal_names
                  else episode.signals[:, episode.signal_names.index(name)].astype(float))
        known = np.isfinite(values)
        if not known.any():
            raise ConfigError(f'signals: demonstration {i} has no {name}; leave it out')
        plain.append(np.stack([np.interp(
            first.stamps + first.pace * offset, seconds[known], values[known])
            for offset in AROUND_S], 1))
        around.append(np.array(AROUND_S))
    pixels = sum(one.shape[1] for one in grey)
    return Film(first.stamps, np.concatenate(plain + grey, 1), pixels,
                np.concatenate([*around, np.zeros(pixels)]))


def _seen_by(other: 'EpisodeStore', seen: tuple[int, int]) -> int | None:
    """Return the episode of another camera that overlaps most with log times, in ns."""
    overlap = [min(seen[1], last) - max(seen[0], first)
               for first, last in map(other.seen, range(len(other)))]
    return int(np.argmax(overlap)) if max(overlap) > 0 else None


def signals_like(store: 'EpisodeStore', parts: Sequence[str]) -> tuple[str, ...]:
    """
    Return the names of the signals of the first demonstration that hold one of some parts.

    :raises ConfigError: for a part that none holds; it lists them.
    """
    names = store[0].signal_names
    for part in parts:
        if not any(part in name for name in names):
            raise ConfigError(f'signals: no name holds {part!r}; expected a part of '
                              f'{listing(names, 20) or "a name, but none are recorded"}')
    return tuple(name for name in names if any(part in name for part in parts))
