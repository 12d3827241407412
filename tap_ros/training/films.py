# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All that was recorded of a demonstration, by several cameras and as signals, as one Film."""

from collections.abc import Sequence
from typing import TYPE_CHECKING
import warnings

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingWarning
from tap_ros.base.text import listing
from tap_ros.training.labels import AROUND_S, Film, film_of
from tap_ros.training.preference import LEAST_FRAMES

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore


def film_together(store: 'EpisodeStore', i: int, beside: Sequence['EpisodeStore'] = (),
                  signals: Sequence[str] = (), hidden: np.ndarray | None = None) -> Film | None:
    """
    Describe a demonstration; None for one that is too short.

    :param store: of the first camera, whose frames may be labels.
    :param beside: of other cameras.
    :param signals: names of those that count, which the demonstration has; their values at the
        times AROUND_S are columns.
    :param hidden: (T, H, W) bool, pixels of the first camera that do not count.
    :raises ConfigError: for a demonstration that another camera did not see.
    """
    first = film_of(store, i, hidden)
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
        assert episode.signals is not None, 'signals_like takes those of all demonstrations'
        values = episode.signals[:, episode.signal_names.index(name)].astype(float)
        known = np.isfinite(values)
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
    Return the names of the signals that hold one of some parts; it warns of those left out.

    Those that some demonstration lacks, which is long enough for labels, are left out.

    :raises ConfigError: for a part that none holds; it lists them.
    """
    if not parts:
        return ()
    names, lacking = dict[str, None](), dict[str, int]()
    for episode in store:
        names |= dict.fromkeys(episode.signal_names)
    for part in parts:
        if not any(part in name for name in names):
            raise ConfigError(f'signals: no name holds {part!r}; expected a part of '
                              f'{listing(names, 20) or "a name, but none are recorded"}')
    chosen = [name for name in names if any(part in name for part in parts)]
    for i in np.flatnonzero(store.lengths >= LEAST_FRAMES).tolist():
        one = store[i]
        known = set() if one.signals is None else {name for name, is_known in zip(
            one.signal_names, np.isfinite(one.signals).any(0)) if is_known}
        lacking |= {name: i for name in chosen if name not in known and name not in lacking}
    if lacking:
        warnings.warn('signals: left out, as demonstrations have no value of them: ' + listing(
            f'{name} (demonstration {i})' for name, i in lacking.items()), RecordingWarning,
            stacklevel=2)
    return tuple(name for name in chosen if name not in lacking)
