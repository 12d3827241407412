# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the page of `python -m tap_ros mark` keeps: marks, in their file, and what to mark next."""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
import shlex
import threading
from typing import Any

from tap_ros.apps.mark_labels import BackgroundLabels
from tap_ros.base.contract import MOST_LEVELS
from tap_ros.base.errors import ConfigError
from tap_ros.base.text import listing
from tap_ros.recording.cache import EpisodeStore
from tap_ros.recording.gripper_moves import gripper_moves
from tap_ros.recording.marks import Mark, read_marks, write_marks
from tap_ros.training.preference import LEAST_FRAMES

ENOUGH = 10  # marked demonstrations, to begin with
MOST_NAMES = 9  # keys 1 to 9
_SPREAD = 12  # demonstrations that are chosen far from each other


class Marking:
    """
    The marks of recordings, kept in their file, and which demonstration to mark next.

    :param recordings: paths of the store.
    :param path: of the file.
    :param names: of the marks of a demonstration, in their order; by default those in the file.
        Without any a demonstration has as many marks as somebody likes.
    :raises ConfigError: for a file that is not of these recordings, and names that do not fit.
    """

    def __init__(self, store: EpisodeStore, recordings: Sequence[str], path: Path,
                 names: Sequence[str] = ()) -> None:
        self.store, self.path, self.recordings = store, path, recordings
        self._lock = threading.Lock()
        self._marks: dict[int, Sequence[Mark]] = {}
        self._by_label: frozenset[int] = frozenset()  # those that nobody has marked
        self.names = tuple(names)
        if path.exists():
            known = read_marks(path, store)
            self._marks, self.names = dict(known.episodes), self.names or known.names
            self._by_label = known.labels
            if known.names and self.names != known.names:
                raise ConfigError(f'names: {listing(names)}, but the marks in {path} are '
                                  f'{listing(known.names)}; leave --names out, or choose another '
                                  'file by --marks')
        other = [i for i, those in self._marks.items() if len(those) != len(self.names)]
        if names and other:
            raise ConfigError(f'names: {listing(names)}, but demonstration {other[0]} has '
                              f'{len(self._marks[other[0]])} marks in {path}; name as many, or '
                              'choose another file by --marks')
        self.usable = [i for i in range(len(store)) if store.lengths[i] >= LEAST_FRAMES]
        if not self.usable:
            raise ConfigError(f'recordings: no episode has {LEAST_FRAMES} frames; record longer '
                              'ones')
        self.labels = BackgroundLabels(store, self.usable)
        self._ask()

    def mark(self, episode: int, frames: Sequence[int]) -> None:
        """
        Replace the marks of an episode, and write the file; without frames it has none.

        :raises ConfigError: for an episode that there is not, frames not between its ends, and
            others than one for each name, in order.
        :raises StorageError: when the file cannot be written; the marks are then what they were.
        """
        known = type(episode) is int and episode in self.usable and isinstance(frames, list)
        if not known or not all(type(t) is int and 0 < t < self.store.lengths[episode] - 1
                                for t in frames):  # True is an int, too
            raise ConfigError('the first frame is the start and the last one the goal; mark a '
                              'frame between them')
        rising = sorted(set(frames))
        if frames and self.names and (frames != rising or len(frames) != len(self.names)):
            raise ConfigError(f'expected a frame for each of {listing(self.names)}, in this order')
        with self._lock:
            marks = {i: those for i, those in self._marks.items() if i != episode}
            if frames:
                marks[episode] = [(t, t) for t in rising]
            by_label = self._by_label - {episode}
            write_marks(self.path, self.store, self.recordings, marks, self.names, by_label)
            self._marks, self._by_label = marks, by_label
            self._ask()

    def state(self) -> dict[str, Any]:
        """Return what the page shows, whatever demonstration it is at."""
        marks, found = self._frames(), self.labels.found
        left = [i for i in self.usable if i not in marks]
        unsure = sorted((i for i in left if i in found),
                        key=lambda i: min(sure for _, sure in found[i]))
        return {'file': str(self.path), 'names': self.names, 'enough': self._enough,
                'lengths': self.store.lengths.tolist(), 'marks': marks,
                'seconds': {i: [round(float(self.store.seconds(i)[t]), 2) for t in frames]
                            for i, frames in marks.items()},
                'labels': {i: found[i] for i in unsure}, 'busy': self.labels.is_busy,
                'order': unsure + spread([i for i in left if i not in found], marks)}

    def about(self, episode: int) -> dict[str, Any]:
        """Return the times of the frames of an episode, and where its gripper moves."""
        last = int(self.store.lengths[episode]) - 1
        return {'seconds': self.store.seconds(episode).round(3).tolist(),
                'moves': [(t, closes) for t, closes in gripper_moves(self.store[episode])
                          if 0 < t < last]}

    def commands(self, options: Sequence[str]) -> list[str]:
        """
        Return the commands that use the marks, once there are enough.

        :param options: that say how the recordings are read.
        """
        marks = self._marks
        if len(marks) < self._enough:
            return []
        place = Path.cwd()
        file = self.path.relative_to(place) if self.path.is_relative_to(place) else self.path
        both = [*self.recordings, '--marks', str(file)]
        name = Path(self.recordings[0]).resolve().stem
        count = len(next(iter(marks.values())))
        height, width = self.store.camera_size or (1, 1)
        crop = [] if '--crop' in options or height == width else ['--crop', 'centre']
        how = [] if count == 1 else ['--recursion', str(count)]
        if count > MOST_LEVELS:  # one of them can be trained on, if it has a name
            how = ['--mark-name', *self.names[:1]]
        how += ['--keyframes', '--no-new-pixels']
        return [shlex.join(['python', '-m', 'tap_ros', *words]) for words in (
            ['label', *both, *_without(options, '--crop'), '--out', f'labels/{name}'],
            ['train', 'predictor', *both, *options, *crop, '--size', '64', *how,
             '--test-fraction', '0.25', '--threads', '1', '--out', f'runs/{name}'])
            if words[0] == 'label' or count <= MOST_LEVELS or self.names]

    @property
    def _enough(self) -> int:
        return min(ENOUGH, len(self.usable))

    def _frames(self) -> dict[int, list[int]]:
        return {i: [(first + last) // 2 for first, last in those]
                for i, those in self._marks.items()}

    def _ask(self) -> None:
        if self._marks:
            self.labels.ask(self._frames(), self.names)


def spread(left: Iterable[int], marked: Collection[int]) -> list[int]:
    """Return demonstrations so that the first ones are far from each other and from the marked."""
    rest, near = list(left), list(marked)
    found: list[int] = []
    while rest and len(found) < _SPREAD:
        found.append(max(rest, key=lambda i: min((abs(i - one) for one in near), default=-i)))
        rest.remove(found[-1])
        near.append(found[-1])
    return found + rest


def _without(options: Sequence[str], name: str) -> list[str]:
    """Return all options but those of a name, of names and values."""
    return [word for pair in zip(options[::2], options[1::2]) if pair[0] != name for word in pair]
