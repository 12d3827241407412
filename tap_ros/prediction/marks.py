# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Marks: the moments of a few demonstrations that a person takes for the bottleneck.

They lie in a small JSON file, beside the recordings as a rule; `python -m tap_ros mark` writes it,
and so can a person:

    {"marks": [
    {"recording": "door", "episode": 0, "stamps": [13.25]},
    {"recording": "door", "episode": 7, "stamps": [[58.5, 59.0]]}
    ]}

A recording is a path from the folder of the file; its episodes count from 0. Stamps are seconds,
of the camera's messages: one a mark, in order of time, or [first, last] of a mark that lasts.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
import hashlib
import json
from math import isfinite
import os
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically
from tap_ros.prediction.preference import (
    describe,
    learn_preference,
    LEAST_FRAMES,
    leave_one_out,
    Preference,
)
from tap_ros.text import escaped
from tap_ros.training.robot_mask import hidden_pixels, RobotMask

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

Mark = tuple[int, int]  # its first and its last frame


@dataclass(frozen=True)
class Marks:
    """
    Marks of episodes of an EpisodeStore.

    :param episodes: index of an episode: its marks, in order of time.
    :param digest: SHA-256 of the file that they come from.
    """

    episodes: Mapping[int, Sequence[Mark]]
    digest: str


def read_marks(path: str | Path, store: 'EpisodeStore') -> Marks:
    """
    Read a file of marks.

    :raises ConfigError: for a file that cannot be read, and for marks of other recordings, of
        episodes that there are not, and outside of their episode; it names the mark.
    """
    name = escaped(path)
    try:
        data = Path(path).read_bytes()
        entries = json.loads(data)['marks']
        found = [(entry['recording'], entry['episode'], entry['stamps']) for entry in entries]
    except OSError as error:
        raise ConfigError(
            f'{name}: {error.strerror}; make it by `python -m tap_ros mark`') from error
    except (LookupError, TypeError, ValueError) as error:
        raise ConfigError(f'{name}: is no file of marks; expected {{"marks": [{{"recording": '
                          '"door", "episode": 0, "stamps": [13.25]}]}, with seconds') from error
    episodes: dict[int, Sequence[Mark]] = {}
    for number, (recording, episode, stamps) in enumerate(found, start=1):
        try:
            i = _episode(store, Path(path).parent, recording, episode)
            if i in episodes:
                raise ValueError('its episode is marked above; put all its stamps in one entry')
            episodes[i] = _frames(store[i].stamps, stamps)
        except (TypeError, ValueError) as error:
            raise ConfigError(f'{name}: mark {number} (recording {escaped(recording, 60)}, episode'
                              f' {escaped(episode, 20)}): {error}') from error
    return Marks(episodes, hashlib.sha256(data).hexdigest())


def _episode(store: 'EpisodeStore', folder: Path, recording: str, episode: int) -> int:
    """Find an episode by its place and number; ValueError says what is wrong."""
    inside = _inside(store, folder / recording)
    if not inside:
        raise ValueError('the recording is none of those that are read; name one by its path from '
                         f'{escaped(folder)}, or give it, too')
    if isinstance(episode, bool) or not 0 <= episode < len(inside):
        raise ValueError(f'there is no such episode; expected 0 to {len(inside) - 1}')
    return inside[episode]


def _frames(stamps: np.ndarray, seconds: Sequence[Any]) -> Sequence[Mark]:
    """Turn seconds into frames between the first one and the last; ValueError says what not."""
    if not isinstance(seconds, list) or not seconds:
        raise ValueError('expected stamps as a list of seconds, such as [13.25]')
    marks = []
    for one in seconds:
        ends = one if isinstance(one, list) else [one, one]
        if len(ends) != 2 or not all(isfinite(end) for end in ends):
            raise ValueError('expected a stamp as seconds, or [first, last]')
        first, last = (int(np.abs(stamps - round(end * 10 ** 9)).argmin()) for end in ends)
        half = np.diff(stamps).max() / 2e9
        begin, end = stamps[0] / 1e9, stamps[-1] / 1e9
        if not begin - half <= ends[0] <= ends[1] <= end + half:
            raise ValueError(f'stamp {escaped(json.dumps(one))} is outside; the episode goes from '
                             f'{begin:.3f} to {end:.3f} s')
        first, last = max(first, 1), min(last, len(stamps) - 2)
        if first > last:
            raise ValueError(f'stamp {escaped(json.dumps(one))} is that of the start or the goal '
                             'picture; mark a moment between them')
        marks.append((first, last))
    if any(a[1] >= b[0] for a, b in zip(marks, marks[1:])):
        raise ValueError('expected the stamps in order of time, of different frames')
    return marks


def _inside(store: 'EpisodeStore', place: Path) -> list[int]:
    """Return the episodes that are recorded in a file or folder."""
    place = place.resolve()
    return [i for i in range(len(store))
            if place in ((file := store.source(i).resolve()), *file.parents)]


def write_marks(path: str | Path, store: 'EpisodeStore', recordings: Iterable[str | Path],
                episodes: Mapping[int, Sequence[Mark]]) -> None:
    """
    Write a file of marks in one step, a mark a line.

    :param recordings: paths of the store.
    :param episodes: as in Marks.
    :raises StorageError: when it cannot be written; an existing file is then what it was.
    """
    folder = Path(path).resolve().parent
    numbers: dict[int, tuple[str, int]] = {}
    for recording in recordings:
        for number, i in enumerate(_inside(store, Path(recording))):
            numbers.setdefault(i, (os.path.relpath(Path(recording).resolve(), folder), number))
    lines = []
    for i, marks in sorted(episodes.items()):
        seconds = [[round(store[i].stamps[t] / 1e9, 6) for t in mark] for mark in marks]
        recording, number = numbers[i]
        lines.append(json.dumps({'recording': recording, 'episode': number, 'stamps': [
            first if first == last else [first, last] for first, last in seconds]}))
    write_atomically(path, '{"marks": [\n' + ',\n'.join(lines) + '\n]}\n')


def features_of(store: 'EpisodeStore', i: int, robot_mask: RobotMask) -> np.ndarray:
    """Describe the frames of an episode, (T, 20), without the pixels that a robot mask hides."""
    episode = store[i]
    return describe(episode.frames, None if robot_mask == 'none' or episode.robot_masks is None
                    else hidden_pixels(episode.robot_masks, robot_mask))


@dataclass(frozen=True)
class Learned:
    """
    What is learned from marks.

    :param preferences: of each level of recursion its w(t).
    :param about: how well a mark is found by what is learned from the others, in each level.
    """

    preferences: Sequence[Preference]
    about: Sequence[Mapping[str, Any]]


def prefer(store: 'EpisodeStore', preferences: Sequence[Callable[[np.ndarray], np.ndarray]],
           robot_mask: RobotMask) -> list[np.ndarray]:
    """
    Compute preferences w(t) in every episode.

    :param preferences: of each level of recursion a function of features (T, 20) to w (T,).
    :return: w of each episode, float32 (levels, T); 1 in those too short for targets.
    """
    found = [np.ones((len(preferences), T), np.float32) for T in store.lengths]
    for i, w in enumerate(found):
        if w.shape[1] >= LEAST_FRAMES:
            features = features_of(store, i, robot_mask)
            w[:] = [preference(features) for preference in preferences]
    return found


def learn_marks(store: 'EpisodeStore', marks: Marks, training: np.ndarray, levels: int,
                forward: bool, robot_mask: RobotMask) -> Learned:
    """
    Learn the preference of each level of recursion from marks, and say how good it is.

    Predictions between start and goal begin with the last mark, those from the start alone with
    the first.

    :param training: indices of the episodes to train on; marks of others are left out.
    :raises ConfigError: without marks there, or where an episode has not one for each level.
    """
    chosen = sorted(set(marks.episodes) & set(training.tolist()))
    if not chosen:
        raise ConfigError(f'marks: none of the {len(marks.episodes)} marked demonstrations is '
                          'trained on; mark some of those that are not held out')
    for i in chosen:
        if len(marks.episodes[i]) != levels:
            raise ConfigError(
                f'marks: demonstration {i} has {len(marks.episodes[i])}, and each needs {levels}, '
                'one for a level of recursion; mark as many, or give --recursion')
    features = [features_of(store, i, robot_mask) for i in chosen]
    preferences, about = [], []
    for level in range(levels):
        at = [marks.episodes[i][level if forward else levels - 1 - level] for i in chosen]
        frames = [(first + last) // 2 for first, last in at]
        preferences.append(learn_preference(features, frames))
        facts: dict[str, Any] = {'demonstrations': len(chosen)}
        if len(chosen) > 1:
            within = leave_one_out(features, frames)
            facts |= {'found': int(within.sum()), 'random': float(np.mean([
                chance((t, t), len(one)) for t, one in zip(frames, features)]))}
        about.append(facts)
    return Learned(preferences, about)


def chance(mark: Mark, length: int, tolerance: int = 1) -> float:
    """Return in which share of the frames between start and goal a mark would be hit."""
    first, last = max(1, mark[0] - tolerance), min(length - 2, mark[1] + tolerance)
    return (last - first + 1) / (length - 2)


def tell(about: Sequence[Mapping[str, Any]]) -> None:
    """Say before a training what the marks are worth; on stderr."""
    from scipy.stats import binomtest  # takes a second to import
    for level, facts in enumerate(about, start=1):
        count = facts['demonstrations']
        name = 'marks' if len(about) == 1 else f'marks, level {level}'
        if 'found' not in facts:
            text = 'one demonstration, so nothing tells what it is worth; mark ten'
        else:
            found, random = facts['found'], facts['random']
            low, high = binomtest(found, count).proportion_ci(method='wilson')
            text = (f'{count} demonstrations. Learned from the others, a mark is found within one '
                    f'frame in {found / count:.0%} ({low:.0%} to {high:.0%}), by a random frame in'
                    f' {random:.0%}')
            if low <= random:
                text += ': they are not told from chance; mark more, or other moments'
        print(f'{name}: {text}', file=sys.stderr)
