# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros mark`: a page in the browser to mark the bottleneck."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from http import HTTPStatus
import json
from pathlib import Path
from typing import Annotated

from tap_ros.apps.marking import Marking, MOST_NAMES
from tap_ros.apps.server import Answer, PageServer, refused
from tap_ros.base.errors import ConfigError, StorageError, TapError
from tap_ros.base.files import only_keeper
from tap_ros.base.options import File
from tap_ros.base.text import escaped
from tap_ros.images.drawing import picture_bytes
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.full_size import FullSize
from tap_ros.recording.marks import beside
from tap_ros.recording.reading import Reading, reading_of, ReadingOptions
from tap_ros.training.labels import SIZE
from tyro import conf


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param recordings: .mcap files, bag folders, or folders of these.
    :param marks: file to write, and to go on from where it is there; by default beside the first
        recording, as its name with .marks.json.
    :param names: of the marks of a demonstration, in their order, such as grasp,release; by
        default those in the file of marks.
    :param port: of the page; 0: any that is free.
    """

    recordings: Annotated[conf.Positional[tuple[str, ...]], conf.arg(
        metavar='BAG [BAG ...]', help_behavior_hint='(required)')]
    marks: File = ''
    names: Annotated[str, conf.arg(metavar='NAME[,NAME...]', help_behavior_hint='')] = ''
    port: int = 8010
    reading: ReadingOptions = ReadingOptions()


class MarkServer(PageServer):
    """
    Answers the page: `state`, `about/EPISODE`, pictures, and `mark`, which marks.

    Pictures are `frame/EPISODE/FRAME`, as recorded, and `small/EPISODE/FRAME`.

    :param options: words of a command line that say how the recordings are read.
    """

    def __init__(self, marking: Marking, port: int = 0, part: str = '',
                 options: Sequence[str] = ()) -> None:
        super().__init__('mark_page', port=port)
        self.marking, self._options = marking, options
        self._full_size = FullSize(marking.store, part)

    def answer(self, path: str, sent: bytes | None) -> Answer:
        """Answer what the page asks for."""
        marking, marked = self.marking, path == 'mark' and sent is not None
        if marked:
            try:
                asked = json.loads(sent or b'')
                marking.mark(asked['episode'], asked['frames'])
            except StorageError as error:
                return refused(HTTPStatus.INSUFFICIENT_STORAGE, str(error))
            except (LookupError, TypeError, ValueError, RecursionError, TapError) as error:
                return refused(HTTPStatus.BAD_REQUEST, str(error))
        if marked or path == 'state':
            return _json(marking.state() | {'commands': marking.commands(self._options)})
        what, *words = path.split('/')
        numbers = [int(word) for word in words if word.isdecimal() and len(word) < 10]
        lengths = marking.store.lengths
        if not numbers or len(numbers) != len(words) or numbers[0] >= len(lengths):
            return super().answer(path, sent)
        if what == 'about' and len(numbers) == 1:
            return _json(marking.about(*numbers))
        if what in ('frame', 'small') and len(numbers) == 2 and numbers[1] < lengths[numbers[0]]:
            data = picture_bytes(self._full_size.picture(*numbers) if what == 'frame'
                                 else marking.store.frames(numbers[0])[numbers[1]])
            kind = 'png' if data.startswith(b'\x89PNG') else 'jpeg'
            return HTTPStatus.OK, data, f'image/{kind}'
        return super().answer(path, sent)


def _json(content: object) -> Answer:
    return HTTPStatus.OK, json.dumps(content).encode(), 'application/json'


def run(args: Options) -> None:
    """
    Serve the page until Ctrl-C.

    :raises TapError: for recordings, names or marks that cannot be used.
    """
    path = Path(args.marks) if args.marks else beside(args.recordings[0])
    names, reading = parse_names(args.names), reading_of(args.reading)
    store = open_recordings(args.recordings, reading=replace(
        reading, crop=reading.crop or 'whole', size=SIZE))
    with only_keeper(path), MarkServer(
            Marking(store, args.recordings, path, names), args.port, reading.crop,
            words_of(reading)) as server:
        with suppress(KeyboardInterrupt):  # the way to end it
            print(f'open {server.url} in a browser; marks go to {escaped(path)}; Ctrl-C ends',
                  flush=True)
            server.serve_forever()
        server.marking.labels.close()


def parse_names(text: str) -> list[str]:
    """
    Return the names of marks in a text with commas.

    :raises ConfigError: for names that are empty, repeat, or are more than there are keys.
    """
    names = [name.strip() for name in text.split(',')] if text else []
    if not all(names) or len({*names}) < len(names) or len(names) > MOST_NAMES:
        raise ConfigError(f'names: expected 1 to {MOST_NAMES} different ones with commas between, '
                          f'such as grasp,release; got {escaped(text, 60)!r}')
    return names


def words_of(reading: Reading) -> list[str]:
    """Return how recordings are read as options of a command line; without the size."""
    words = []
    for field in fields(reading):
        value = getattr(reading, field.name)
        if value != field.default and field.name != 'size':
            for one in value if isinstance(value, tuple) else (value,):
                words += [f'--{field.name.replace("_", "-")}', str(one)]
    return words
