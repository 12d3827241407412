# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros mark`: a page in the browser to mark the bottleneck."""

from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from importlib.resources import files
import json
from pathlib import Path
import threading
from typing import Annotated, Any

from tap_ros.apps.server import Answer, PageServer, refused
from tap_ros.base.errors import ConfigError, StorageError, TapError
from tap_ros.base.files import only_keeper
from tap_ros.base.options import File
from tap_ros.base.text import escaped
from tap_ros.images.drawing import png_bytes
from tap_ros.recording.cache import EpisodeStore, open_recordings
from tap_ros.recording.marks import beside, Mark, read_marks, write_marks
from tap_ros.recording.reading import reading_of, ReadingOptions
from tap_ros.training.preference import LEAST_FRAMES
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param recordings: .mcap files, bag folders, or folders of these.
    :param marks: file to write, and to go on from where it is there; by default beside the first
        recording, as its name with .marks.json.
    :param port: of the page; 0: any that is free.
    """

    recordings: Annotated[conf.Positional[tuple[str, ...]], conf.arg(
        metavar='BAG [BAG ...]', help_behavior_hint='(required)')]
    marks: File = ''
    port: int = 8010
    reading: ReadingOptions = ReadingOptions()


class Marking:
    """
    The marks of recordings, kept in their file, and which demonstration to mark next.

    :param path: of the file.
    :param recordings: paths of the store.
    :raises ConfigError: for a file that is not of these recordings.
    """

    def __init__(self, store: EpisodeStore, recordings: Sequence[str], path: Path) -> None:
        self.store, self.path, self._recordings = store, path, recordings
        self._lock = threading.Lock()
        self._marks: dict[int, Sequence[Mark]] = {}
        self._names: Sequence[str] = ()
        if path.exists():
            known = read_marks(path, store)
            self._marks, self._names = dict(known.episodes), known.names
        self._usable = [i for i in range(len(store)) if store.lengths[i] >= LEAST_FRAMES]
        if not self._usable:
            raise ConfigError(f'recordings: no episode has {LEAST_FRAMES} frames; record longer '
                              'ones')

    def mark(self, episode: int, frames: Sequence[int]) -> None:
        """
        Replace the marks of an episode, and write the file; without frames it has none.

        :raises ConfigError: for an episode that there is not, and frames not between its ends.
        :raises StorageError: when the file cannot be written; the marks are then what they were.
        """
        known = isinstance(episode, int) and episode in self._usable and isinstance(frames, list)
        if not known or not all(isinstance(t, int) and 0 < t < self.store.lengths[episode] - 1
                                for t in frames):
            raise ConfigError('expected an episode and frames between its start and its goal')
        with self._lock:
            marks = {i: those for i, those in self._marks.items() if i != episode}
            if frames:
                marks[episode] = [(t, t) for t in sorted(set(frames))]
            write_marks(self.path, self.store, self._recordings, marks, self._names)
            self._marks = marks

    def state(self) -> dict[str, Any]:
        """Return what the page shows; next is farthest from the marked ones, None if all are."""
        marks = self._marks
        return {'file': str(self.path), 'lengths': self.store.lengths.tolist(),
                'marks': {i: [(first + last) // 2 for first, last in those]
                          for i, those in marks.items()},
                'next': max((i for i in self._usable if i not in marks), default=None,
                            key=lambda i: min((abs(i - marked) for marked in marks), default=-i))}


class MarkServer(PageServer):
    """Answers `state`, `frame/EPISODE/FRAME` and `mark`, which marks, beside the page."""

    def __init__(self, marking: Marking, port: int = 0) -> None:
        super().__init__(files('tap_ros.apps').joinpath('mark_page'), port=port)
        self.marking = marking

    def answer(self, path: str, sent: bytes | None) -> Answer:
        """Answer what the page asks for."""
        store, (what, *numbers) = self.marking.store, path.split('/')
        if path == 'mark' and sent is not None:
            try:
                asked = json.loads(sent)
                self.marking.mark(asked['episode'], asked['frames'])
            except StorageError as error:
                return refused(HTTPStatus.INSUFFICIENT_STORAGE, str(error))
            except (LookupError, TypeError, ValueError, RecursionError, TapError) as error:
                return refused(HTTPStatus.BAD_REQUEST, str(error))
        elif what == 'frame' and len(numbers) == 2 and all(
                number.isdecimal() and len(number) < 10 for number in numbers):
            episode, t = map(int, numbers)
            if episode < len(store) and t < store.lengths[episode]:
                return HTTPStatus.OK, png_bytes(store.frames(episode)[t]), 'image/png'
            return super().answer(path, sent)
        elif path != 'state':
            return super().answer(path, sent)
        return HTTPStatus.OK, json.dumps(self.marking.state()).encode(), 'application/json'


def run(args: Options) -> None:
    """
    Serve the page until Ctrl-C.

    :raises TapError: for recordings or marks that cannot be used.
    """
    path = Path(args.marks) if args.marks else beside(args.recordings[0])
    store = open_recordings(args.recordings, reading=reading_of(args.reading))
    with only_keeper(path), MarkServer(Marking(store, args.recordings, path), args.port) as server:
        print(f'open {server.url} in a browser; marks go to {escaped(path)}; Ctrl-C ends',
              flush=True)
        server.serve_forever()
