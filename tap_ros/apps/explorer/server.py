# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Serves the explorer's page and its WebSocket from one port, in a thread of its own.

Another page that is open in the same browser can connect to servers on this machine, too. So a
browser is answered only where the page that connects is our own, and anybody who comes from
another machine needs a token.
"""

import asyncio
from collections.abc import Callable
import contextlib
from http import HTTPStatus
from importlib.resources import files
import ipaddress
import json
import logging
import secrets
import threading
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, quote, urlsplit

from tap_ros.base.errors import ConfigError, TapError
from tap_ros.base.text import escaped
from websockets.asyncio.server import serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request

SOCKET = '/socket'
MAX_COMMAND = 4096  # bytes
MAX_BROWSERS = 64
_PAGE = {'/': ('index.html', 'text/html'), '/explorer.css': ('explorer.css', 'text/css'), **{
    f'/{name}.js': (f'{name}.js', 'text/javascript')
    for name in ('explorer', 'pictures', 'hands')}}
_POLICY = ("default-src 'none'; script-src 'self'; style-src 'self'; img-src blob: data:; "
           "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'")
_START_S, _END_S = 10.0, 5.0


class ExplorerServer:
    """
    Shows browsers the newest of each kind of content, and takes their commands.

    Nothing is queued: who is slow misses what was replaced meanwhile, and gets the newest.

    :param on_command: called with the text of each command, in the server's thread: it must not
        block. A TapError that it raises is told to the browser that asked.
    :param host: address to listen at.
    :param port: to listen at; 0: any that is free.
    :param token: that browsers must know; '' where host is of this machine alone: none is needed,
        else one is made up.
    :ivar browsers: how many are connected.
    :raises ConfigError: when the address cannot be used; the message says why.
    """

    def __init__(self, on_command: Callable[[str | bytes], object], host: str = '127.0.0.1',
                 port: int = 8000, token: str = '') -> None:
        if not host:
            raise ConfigError('parameter host: is empty; name an address, such as 127.0.0.1')
        self._on_command, self._host = on_command, host
        self._token = token or ('' if is_loopback(host) else secrets.token_urlsafe(16))
        self._contents: dict[str, tuple[int, str | bytes]] = {}  # kind -> (number, content)
        self._count = 0  # of changes
        self._changed: set[asyncio.Event] = set()  # one for each browser
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._started = threading.Event()
        self._error: Exception | None = None
        self.port, self.browsers = port, 0
        self._thread = threading.Thread(target=self._run, name='explorer', daemon=True)
        self._thread.start()
        if not self._started.wait(_START_S) or self._error:
            raise ConfigError(f'parameters host, port: cannot listen at {escaped(host, 100)}:'
                              f'{port}: {escaped(self._error or "no answer", 200)}; choose '
                              'another port, or 0 for any that is free')

    @property
    def url(self) -> str:
        """Where the page is, with the token where one is needed."""
        host = f'[{self._host}]' if ':' in self._host else self._host
        return f'http://{host}:{self.port}/' + (
            f'?token={quote(self._token, safe="")}' if self._token else '')

    def put(self, kind: str, content: str | bytes) -> None:
        """Replace the content of a kind; an equal one changes nothing. From any thread."""
        with contextlib.suppress(RuntimeError):  # the server has ended
            self._loop.call_soon_threadsafe(self._put, kind, content)

    def close(self) -> None:
        """Say goodbye to all browsers and free the port."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join(_END_S)

    # In the thread of the server

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:  # an address can be wrong in many ways
            self._error = error
        finally:
            self._started.set()
            self._loop.close()

    async def _serve(self) -> None:
        # Of what browsers do wrong, websockets would log whole tracebacks.
        logger = logging.getLogger('tap_ros.apps.explorer')
        logger.setLevel(logging.CRITICAL)
        async with serve(self._converse, self._host, self.port, process_request=self._answer,
                         max_size=MAX_COMMAND, max_queue=4, logger=logger,
                         close_timeout=1.0, compression=None, server_header=None) as server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._started.set()
            await self._ended.wait()

    def _put(self, kind: str, content: str | bytes) -> None:
        if self._contents.get(kind, (0, None))[1] != content:
            self._count += 1
            self._contents[kind] = self._count, content
            for changed in self._changed:
                changed.set()

    def _answer(self, _: 'ServerConnection', request: 'Request') -> Response | None:
        """Answer a request that is not to become a WebSocket; None lets it become one."""
        try:
            url = urlsplit(request.path)
            own, known = self._is_own(request), self._knows_token(url.query)
        except ValueError:  # an address or a header that is none
            return _page(HTTPStatus.BAD_REQUEST, 'This address cannot be read.')
        if not own:
            return _page(HTTPStatus.FORBIDDEN, 'This page may not be used from there.')
        # The page asks for its own files without the token, in which there is nothing to hide.
        if url.path in ('/', SOCKET) and not known:
            return _page(HTTPStatus.UNAUTHORIZED, 'A token is needed: open the address that '
                                                  'explorer_node printed when it started.')
        if url.path == SOCKET:
            if self.browsers >= MAX_BROWSERS:
                return _page(HTTPStatus.SERVICE_UNAVAILABLE, 'Too many browsers are connected.')
            return None
        if url.path not in _PAGE:
            return _page(HTTPStatus.NOT_FOUND, 'There is nothing here.')
        name, kind = _PAGE[url.path]
        body = files('tap_ros.apps.explorer').joinpath('page', name).read_bytes()
        return _page(HTTPStatus.OK, body, kind)

    def _is_own(self, request: 'Request') -> bool:
        """Return whether our own page asks, under a name of this server."""
        host = ','.join(request.headers.get_all('Host'))
        origins = request.headers.get_all('Origin')
        if any(urlsplit(origin).netloc != host for origin in origins):
            return False  # another page
        # Else a name of another machine could be made to lead here.
        return is_loopback(urlsplit(f'//{host}').hostname or '') or bool(self._token)

    def _knows_token(self, query: str) -> bool:
        token = ''.join(parse_qs(query).get('token', []))
        return not self._token or secrets.compare_digest(token.encode(), self._token.encode())

    async def _converse(self, browser: 'ServerConnection') -> None:
        """Send what changes and take commands until the browser goes."""
        self.browsers += 1
        changed = asyncio.Event()
        self._changed.add(changed)
        sender = asyncio.create_task(self._send(browser, changed))
        try:
            async for text in browser:
                try:
                    self._on_command(text)
                except TapError as error:
                    await browser.send(json.dumps({'kind': 'error', 'text': str(error)}))
        except ConnectionClosed:
            pass
        finally:
            self._changed.remove(changed)
            self.browsers -= 1
            sender.cancel()

    async def _send(self, browser: 'ServerConnection', changed: asyncio.Event) -> None:
        """Send the newest of each kind, the oldest change first, to a browser that may be slow."""
        sent = 0
        with contextlib.suppress(ConnectionClosed):
            while True:
                changed.clear()
                new = sorted((number, kind, content) for kind, (number, content)
                             in self._contents.items() if number > sent)
                sent = self._count
                for _, kind, content in new:
                    await browser.send(content if isinstance(content, str)
                                       else kind.encode() + b'\0' + content)
                await changed.wait()


def is_loopback(host: str) -> bool:
    """Return whether a name or address leads to this machine alone."""
    if host == 'localhost':
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _page(status: HTTPStatus, body: str | bytes, kind: str = 'text/plain') -> Response:
    """Return a whole answer."""
    content = body.encode() if isinstance(body, str) else body
    return Response(status.value, status.phrase, Headers({
        'Content-Type': f'{kind}; charset=utf-8', 'Content-Length': str(len(content)),
        'Content-Security-Policy': _POLICY, 'X-Content-Type-Options': 'nosniff',
        'Referrer-Policy': 'no-referrer', 'Cache-Control': 'no-store',
        'Connection': 'close'}), content)
