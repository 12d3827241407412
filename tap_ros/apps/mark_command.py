# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The command `python -m tap_ros mark`: a page in the browser to mark the bottleneck in a few frames.

The server is for this machine alone, and a page of another site cannot write through it.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
import json
from pathlib import Path
import socket
import threading
import time
from typing import Annotated, Any

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

_HOST = '127.0.0.1'
MAX_BODY = 2 ** 16  # bytes
MAX_CONNECTIONS = 64
LONGEST_S = 20.0  # of a connection
_PAGE = {'/': ('mark.html', 'text/html'), '/mark.js': ('mark.js', 'text/javascript')}
_POLICY = ("default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; "
           "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
           "frame-ancestors 'none'")


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
        if path.exists():
            self._marks = dict(read_marks(path, store).episodes)
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
            write_marks(self.path, self.store, self._recordings, marks)
            self._marks = marks

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        with self._lock:
            return {'file': str(self.path), 'lengths': self.store.lengths.tolist(),
                    'marks': {i: [(first + last) // 2 for first, last in marks]
                              for i, marks in self._marks.items()},
                    'next': self._next()}

    def _next(self) -> int | None:
        """Return the demonstration farthest from those that are marked; None if all are."""
        left = [i for i in self._usable if i not in self._marks]
        return max(left, default=None, key=lambda i: min(
            (abs(i - marked) for marked in self._marks), default=-i))


class Server(ThreadingHTTPServer):
    """
    Serves the page; its server_port says where. Connections are few and end in time.

    :raises ConfigError: for a port that cannot be used.
    """

    def __init__(self, marking: Marking, port: int = 0) -> None:
        self.marking = marking
        self._ends: dict[socket.socket, float] = {}  # s, monotonic, of the open connections
        try:
            super().__init__((_HOST, port), Handler)
        except (OSError, OverflowError) as error:
            raise ConfigError(f'port {port}: cannot be listened at ({error}); choose another, or '
                              '0 for any that is free') from error

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Take no more connections than browsers make."""
        return len(self._ends) < MAX_CONNECTIONS

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread."""
        self._ends[request] = time.monotonic() + LONGEST_S
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Forget a connection."""
        self._ends.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """End connections that take too long, from time to time."""
        for request, end in list(self._ends.items()):
            if time.monotonic() > end:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, *_: object) -> None:
        """Say nothing of browsers that go away."""


class Handler(BaseHTTPRequestHandler):
    """Answers `/state`, `/frame/EPISODE/FRAME`, the page's files, and `/mark` that marks."""

    server: Server

    def do_GET(self) -> None:
        """Answer what only shows."""
        path, *numbers = self.path.strip('/').split('/')
        if not self._is_own():
            self._refuse(HTTPStatus.FORBIDDEN, 'This page may not be used from there.')
        elif self.path in _PAGE:
            name, kind = _PAGE[self.path]
            self._send(files('tap_ros.apps').joinpath('mark_page', name).read_bytes(), kind)
        elif path == 'state':
            self._send_state()
        elif path == 'frame' and len(numbers) == 2 and all(
                number.isdecimal() and len(number) < 10 for number in numbers):
            self._send_frame(*map(int, numbers))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, 'There is nothing here.')

    def do_POST(self) -> None:
        """Mark what the page asks for."""
        if not self._is_own():
            self._refuse(HTTPStatus.FORBIDDEN, 'This page may not be used from there.')
            return
        try:
            size = int(self.headers.get('Content-Length', 0))
            if not 0 <= size <= MAX_BODY:
                self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                             f'Expected at most {MAX_BODY} bytes.')
                return
            asked = json.loads(self.rfile.read(size))
            self.server.marking.mark(asked['episode'], asked['frames'])
        except StorageError as error:
            self._refuse(HTTPStatus.INSUFFICIENT_STORAGE, str(error))
        except (LookupError, TypeError, ValueError, RecursionError, TapError) as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._send_state()

    def _is_own(self) -> bool:
        """Return whether our own page asks, under the name of this machine alone."""
        host, origin = self.headers.get('Host', ''), self.headers.get('Origin')
        return host.rpartition(':')[0] in (_HOST, 'localhost') and origin in (
            None, f'http://{host}')

    def _send_state(self) -> None:
        self._send(json.dumps(self.server.marking.state()).encode(), 'application/json')

    def _send_frame(self, episode: int, t: int) -> None:
        store = self.server.marking.store
        if episode >= len(store) or t >= store.lengths[episode]:
            self._refuse(HTTPStatus.NOT_FOUND, 'There is no such frame.')
        else:
            self._send(png_bytes(store.frames(episode)[t]), 'image/png')

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._send(why.encode(), 'text/plain', status)

    def _send(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        for name, value in (('Content-Type', f'{kind}; charset=utf-8'),
                            ('Content-Length', str(len(body))),
                            ('Content-Security-Policy', _POLICY),
                            ('X-Content-Type-Options', 'nosniff'), ('Cache-Control', 'no-store')):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


def run(args: Options) -> None:
    """
    Serve the page until Ctrl-C.

    :raises TapError: for recordings or marks that cannot be used.
    """
    path = Path(args.marks) if args.marks else beside(args.recordings[0])
    store = open_recordings(args.recordings, reading=reading_of(args.reading))
    with (only_keeper(path),
          Server(Marking(store, args.recordings, path), args.port) as server):
        print(f'open http://{_HOST}:{server.server_port} in a browser; marks go to '
              f'{escaped(path)}; Ctrl-C ends', flush=True)
        server.serve_forever()
