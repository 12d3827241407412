# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Serves a page for browsers, and what the page asks for, to nobody else.

Another page that is open in the same browser can connect to servers on this machine, too. So a
browser is answered only where the page that connects is our own, and anybody who comes from
another machine needs a token. Connections are few and end in time.
"""

from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from importlib.resources import files
import ipaddress
import secrets
import socket
from socketserver import TCPServer, ThreadingMixIn
import time
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

from tap_ros.base.errors import ConfigError
from tap_ros.base.text import escaped

SOCKET = '/socket'
MAX_BODY = 2 ** 16  # bytes
MAX_CONNECTIONS = 64  # beside WebSockets
LONGEST_S = 20.0  # of a connection
_KINDS = {'html': 'text/html', 'css': 'text/css', 'js': 'text/javascript'}
_HEADERS = {
    'Content-Security-Policy':
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    'X-Content-Type-Options': 'nosniff', 'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store', 'Connection': 'close'}
Answer = tuple[HTTPStatus, bytes, str]  # body and its type


class PageServer(ThreadingMixIn, TCPServer):
    """
    Serves the files of a page; serve_forever answers, each connection in a thread.

    :param page: folder of the files in this one, index.html among them, besides those that all
        pages share.
    :param host: address to listen at.
    :param port: to listen at; 0: any that is free.
    :param token: that browsers must know; '' where host is of this machine alone: none is needed,
        else one is made up.
    :ivar port: that it listens at.
    :raises ConfigError: when the address cannot be used; the message says why.
    """

    allow_reuse_address = daemon_threads = True
    request_queue_size = MAX_CONNECTIONS

    def __init__(self, page: str, host: str = '127.0.0.1', port: int = 0,
                 token: str = '') -> None:
        if not host:
            raise ConfigError('host: is empty; name an address, such as 127.0.0.1')
        self.host = host
        self.token = token or ('' if is_loopback(host) else secrets.token_urlsafe(16))
        self.files = {file.name: file.read_bytes() for folder in ('shared_page', page)
                      for file in files('tap_ros.apps').joinpath(folder).iterdir()
                      if file.is_file()}
        self.ends: dict[socket.socket, float] = {}  # s, monotonic, of connections but WebSockets
        try:
            self.address_family, *_, place = socket.getaddrinfo(
                host, port, type=socket.SOCK_STREAM)[0]
            super().__init__((str(place[0]), port), Handler)
        except (OSError, OverflowError, ValueError) as error:
            raise ConfigError(f'host, port: cannot listen at {escaped(host, 100)}:{port}: '
                              f'{escaped(error, 200)}; choose another port, or 0 for any that is '
                              'free') from error
        self.port: int = self.server_address[1]

    @property
    def url(self) -> str:
        """Where the page is, with the token where one is needed."""
        host = f'[{self.host}]' if ':' in self.host else self.host
        return f'http://{host}:{self.port}/' + (
            f'?token={quote(self.token, safe="")}' if self.token else '')

    def answer(self, path: str, sent: bytes | None) -> Answer:
        """Answer what is no file of the page; sent: what a POST has, None of a GET."""
        return refused(HTTPStatus.NOT_FOUND, 'There is nothing here.')

    def converse(self, request: 'Handler') -> None:
        """Make a connection a WebSocket, and end with it."""
        request.send(refused(HTTPStatus.NOT_FOUND, 'There is nothing here.'))

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Take no more connections than browsers make."""
        return len(self.ends) < MAX_CONNECTIONS

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread."""
        self.ends[request] = time.monotonic() + LONGEST_S
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Forget a connection."""
        self.ends.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """End connections that take too long, from time to time."""
        for request, end in list(self.ends.items()):
            if time.monotonic() > end:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, *_: object) -> None:
        """Say nothing of browsers that go away."""


class Handler(BaseHTTPRequestHandler):
    """Answers one request, of the page itself alone."""

    server: PageServer
    protocol_version = 'HTTP/1.1'

    def do_GET(self) -> None:
        """Answer, or say why not."""
        server = self.server
        try:
            url = urlsplit(self.path)
            own, known = self._is_own(), self._knows_token(url.query)
            size = int(self.headers.get('Content-Length', 0))
        except ValueError:  # an address or a header that is none
            self.send(refused(HTTPStatus.BAD_REQUEST, 'This address cannot be read.'))
            return
        path = url.path.strip('/') or 'index.html'
        if not own:
            self.send(refused(HTTPStatus.FORBIDDEN, 'This page may not be used from there.'))
        # The page asks for its own files without the token, in which there is nothing to hide.
        elif not known and (path == 'index.html' or path not in server.files):
            self.send(refused(HTTPStatus.UNAUTHORIZED, 'A token is needed: open the address that '
                                                       'was printed at the start.'))
        elif not 0 <= size <= MAX_BODY:
            self.send(refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                              f'Expected at most {MAX_BODY} bytes.'))
        elif url.path == SOCKET:
            server.converse(self)
        elif path in server.files:
            self.send((HTTPStatus.OK, server.files[path], _KINDS[path.rpartition('.')[2]]))
        else:
            sent = self.rfile.read(size) if self.command == 'POST' else None
            self.send(server.answer(path, sent))

    do_POST = do_GET

    def send(self, answer: Answer) -> None:
        """Send a whole answer."""
        status, body, kind = answer
        self.send_response_only(status)
        for name, value in {'Content-Type': f'{kind}; charset=utf-8',
                            'Content-Length': str(len(body)), **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _is_own(self) -> bool:
        """Return whether our own page asks, under a name of this server."""
        host = ','.join(self.headers.get_all('Host', []))
        if any(urlsplit(origin).netloc != host for origin in self.headers.get_all('Origin', [])):
            return False  # another page
        # Else a name of another machine could be made to lead here.
        return is_loopback(urlsplit(f'//{host}').hostname or '') or bool(self.server.token)

    def _knows_token(self, query: str) -> bool:
        token, wanted = ''.join(parse_qs(query).get('token', [])), self.server.token
        return not wanted or secrets.compare_digest(token.encode(), wanted.encode())

    def log_message(self, *_: object) -> None:
        """Print nothing."""


def refused(status: HTTPStatus, why: str) -> Answer:
    """Return an answer that says why there is no other."""
    return status, why.encode(), 'text/plain'


def is_loopback(host: str) -> bool:
    """Return whether a name or address leads to this machine alone."""
    if host == 'localhost':
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
