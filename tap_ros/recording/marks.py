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
Before "marks" there may be the names of an episode's marks: "names": ["grasp", "release"]. An
entry with "label": true was not marked by a person, but labelled by `python -m tap_ros label`.
"""

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import hashlib
import json
from math import isfinite
import os
from pathlib import Path
from typing import Any, Self, TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.base.files import write_atomically
from tap_ros.base.text import escaped, listing
from tap_ros.recording.trust import parse_json, read_bytes

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore

Mark = tuple[int, int]  # its first and its last frame
_MOST_BYTES = 2**26  # of a file of marks


@dataclass(frozen=True)
class Marks:
    """
    Marks of episodes of an EpisodeStore.

    :param episodes: index of an episode: its marks, in order of time.
    :param digest: SHA-256 of the file that they come from.
    :param names: of the marks of each episode, in order; () where they have none.
    :param labels: the episodes that `label` labelled, and nobody marked.
    """

    episodes: Mapping[int, Sequence[Mark]]
    digest: str
    names: tuple[str, ...] = ()
    labels: frozenset[int] = frozenset()

    @property
    def marked(self) -> dict[int, Sequence[Mark]]:
        """Return the marks of the episodes that a person marked."""
        return {i: those for i, those in self.episodes.items() if i not in self.labels}

    def number(self, name: str, episodes: Iterable[int]) -> int:
        """
        Return the number, from 0, of the marks of a name.

        :raises ConfigError: if there is no such name, or one of the episodes has not as many
            marks as there are names.
        """
        if name not in self.names:
            raise ConfigError(f'mark_name: {escaped(name, 60)} is none of the marks; expected ' + (
                f'one of {listing(self.names)}' if self.names else 'marks that have names'))
        for i in episodes:
            if len(self.episodes[i]) != len(self.names):
                raise ConfigError(f'marks: demonstration {i} has {len(self.episodes[i])}, not as '
                                  f'many as the names {listing(self.names)}; mark it again')
        return self.names.index(name)

    def named(self, name: str) -> Self:
        """Return the marks of one name alone; ConfigError as number, of all episodes."""
        k = self.number(name, self.episodes)
        return replace(self, names=(name,),
                       episodes={i: those[k:k + 1] for i, those in self.episodes.items()})


def beside(recording: str | Path) -> Path:
    """Return where the marks of a recording are as a rule."""
    place = Path(recording).resolve()
    return place.with_name(f'{place.name}.marks.json')


def read_marks(path: str | Path, store: 'EpisodeStore') -> Marks:
    """
    Read a file of marks.

    :raises ConfigError: for a file that cannot be read, and for marks of other recordings, of
        episodes that there are not, and outside of their episode; it names the mark.
    """
    name = escaped(path)
    try:
        data = read_bytes(path, _MOST_BYTES)
        content = parse_json(data)
        entries, names = content['marks'], content.get('names', [])
        found = [(entry['recording'], entry['episode'], entry['stamps'], entry.get('label'))
                 for entry in entries]
        if not isinstance(names, list) or not all(
                isinstance(name, str) and name for name in names) or len({*names}) < len(names):
            raise ConfigError(f'{name}: "names" are not usable; expected a list of different ones,'
                              ' such as ["grasp", "release"]')
        if not all(isinstance(one[0], str) and type(one[1]) is int for one in found):
            raise TypeError
    except OSError as error:
        raise ConfigError(
            f'{name}: {error.strerror}; make it by `python -m tap_ros mark`') from error
    except RecordingError as error:
        raise ConfigError(str(error)) from error
    except (LookupError, TypeError, ValueError) as error:
        raise ConfigError(f'{name}: is no file of marks; expected {{"marks": [{{"recording": '
                          '"door", "episode": 0, "stamps": [13.25]}]}, with seconds') from error
    episodes: dict[int, Sequence[Mark]] = {}
    labels = set()
    for number, (recording, episode, stamps, label) in enumerate(found, start=1):
        try:
            i = _episode(store, Path(path).parent, recording, episode)
            if i in episodes:
                raise ValueError('its episode is marked above; put all its stamps in one entry')
            episodes[i] = _frames(store[i].stamps, stamps)
            labels |= {i} if label is True else set()
        except (TypeError, ValueError, OverflowError, RuntimeError, OSError) as error:
            raise ConfigError(f'{name}: mark {number} (recording {escaped(recording, 60)}, episode'
                              f' {escaped(episode, 20)}): {error}') from error
    return Marks(episodes, hashlib.sha256(data).hexdigest(), tuple(names), frozenset(labels))


def _episode(store: 'EpisodeStore', folder: Path, recording: str, episode: int) -> int:
    """Find an episode by its place and number; ValueError says what is wrong."""
    inside = episodes_in(store, folder / recording)
    if not inside:
        raise ValueError('the recording is none of those that are read; name one by its path from '
                         f'{escaped(folder)}, or give it, too')
    if not 0 <= episode < len(inside):
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


def episodes_in(store: 'EpisodeStore', place: Path) -> list[int]:
    """Return the episodes that are recorded in a file or folder."""
    place = place.resolve()
    return [i for i in range(len(store))
            if place in ((file := store.source(i).resolve()), *file.parents)]


def numbered(store: 'EpisodeStore', recordings: Iterable[str | Path],
             folder: Path) -> dict[int, tuple[str, int]]:
    """Return of each episode its recording, as a path from a folder, and its number in it."""
    numbers: dict[int, tuple[str, int]] = {}
    for recording in recordings:
        for number, i in enumerate(episodes_in(store, Path(recording))):
            numbers.setdefault(i, (os.path.relpath(Path(recording).resolve(), folder), number))
    return numbers


def write_marks(path: str | Path, store: 'EpisodeStore', recordings: Iterable[str | Path],
                episodes: Mapping[int, Sequence[Mark]], names: Sequence[str] = (),
                labels: Container[int] = ()) -> None:
    """
    Write a file of marks in one step, a mark a line.

    :param recordings: paths of the store.
    :param episodes: marks by the index of their episode.
    :param names: of the marks of a demonstration, in their order.
    :param labels: the episodes that nobody marked.
    :raises StorageError: when it cannot be written; an existing file is then what it was.
    """
    numbers = numbered(store, recordings, Path(path).resolve().parent)
    lines = []
    for i, marks in sorted(episodes.items()):
        seconds = [[round(store[i].stamps[t] / 1e9, 6) for t in mark] for mark in marks]
        recording, number = numbers[i]
        lines.append(json.dumps({'recording': recording, 'episode': number, 'stamps': [
            first if first == last else [first, last] for first, last in seconds],
            **({'label': True} if i in labels else {})}))
    named = f'"names": {json.dumps(list(names))}, ' if names else ''
    write_atomically(path, f'{{{named}"marks": [\n' + ',\n'.join(lines) + '\n]}\n')
