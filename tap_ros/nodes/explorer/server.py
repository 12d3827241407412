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

from tap_ros.errors import ConfigError, TapError
from tap_ros.nodes.explorer.board import Board
from tap_ros.text import escaped
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
_PAGE = {'/': ('index.html', 'text/html'), '/explorer.js': ('explorer.js', 'text/javascript'),
         '/explorer.css': ('explorer.css', 'text/css')}
_POLICY = ("default-src 'none'; script-src 'self'; style-src 'self'; img-src blob: data:; "
           "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'")
_START_S, _END_S = 10.0, 5.0


class ExplorerServer:
    """
    Shows a Board to browsers and takes their commands.

    :param board: Board.
    :param on_command: called with the text of each command, in the server's thread: it must not
        block. A TapError that it raises is told to the browser that asked.
    :param host: address to listen at.
    :param port: to listen at; 0: any that is free.
    :param token: that browsers must know; '' where host is of this machine alone: none is needed,
        else one is made up.
    :raises ConfigError: when the address cannot be used; the message says why.
    """

    def __init__(self, board: Board, on_command: Callable[[str | bytes], object],
                 host: str = '127.0.0.1', port: int = 8000, token: str = '') -> None:
        if not host:
            raise ConfigError('parameter host: is empty; name an address, such as 127.0.0.1')
        self._board, self._on_command, self._host = board, on_command, host
        self._token = token or ('' if is_loopback(host) else secrets.token_urlsafe(16))
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._started = threading.Event()
        self._error: Exception | None = None
        self._browsers = 0
        self.port = port
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

    @property
    def browsers(self) -> int:
        """How many are connected."""
        return self._browsers

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
        logger = logging.getLogger('tap_ros.nodes.explorer')
        logger.setLevel(logging.CRITICAL)
        async with serve(self._converse, self._host, self.port, process_request=self._answer,
                         max_size=MAX_COMMAND, max_queue=4, logger=logger,
                         close_timeout=1.0, compression=None, server_header=None) as server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._started.set()
            await self._ended.wait()

    def _answer(self, _: 'ServerConnection', request: 'Request') -> Response | None:
        """Answer a request that is not to become a WebSocket; None lets it become one."""
        url = urlsplit(request.path)
        if not self._is_own(request):
            return _page(HTTPStatus.FORBIDDEN, 'This page may not be used from there.')
        # The page asks for its own files without the token, in which there is nothing to hide.
        if url.path in ('/', SOCKET) and self._token and not secrets.compare_digest(
                ''.join(parse_qs(url.query).get('token', [])).encode(), self._token.encode()):
            return _page(HTTPStatus.UNAUTHORIZED, 'A token is needed: open the address that '
                                                  'explorer_node printed when it started.')
        if url.path == SOCKET:
            if self._browsers >= MAX_BROWSERS:
                return _page(HTTPStatus.SERVICE_UNAVAILABLE, 'Too many browsers are connected.')
            return None
        if url.path not in _PAGE:
            return _page(HTTPStatus.NOT_FOUND, 'There is nothing here.')
        name, kind = _PAGE[url.path]
        body = files('tap_ros.nodes.explorer').joinpath('page', name).read_bytes()
        return _page(HTTPStatus.OK, body, kind)

    def _is_own(self, request: 'Request') -> bool:
        """Return whether our own page asks, under a name of this server."""
        host = ','.join(request.headers.get_all('Host'))
        origins = request.headers.get_all('Origin')
        if any(urlsplit(origin).netloc != host for origin in origins):
            return False  # another page
        # Else a name of another machine could be made to lead here.
        return bool(self._token) or is_loopback(urlsplit(f'//{host}').hostname or '')

    async def _converse(self, browser: 'ServerConnection') -> None:
        """Send what changes and take commands until the browser goes."""
        self._browsers += 1
        changed = asyncio.Event()

        def tell() -> None:
            with contextlib.suppress(RuntimeError):  # the server has ended meanwhile
                self._loop.call_soon_threadsafe(changed.set)

        self._board.watch(tell)
        sender = asyncio.create_task(self._send(browser, changed))
        try:
            async for text in browser:
                try:
                    self._on_command(text)
                except TapError as error:
                    await browser.send(message('error', str(error)))
        except ConnectionClosed:
            pass
        finally:
            self._board.leave(tell)
            self._browsers -= 1
            sender.cancel()

    async def _send(self, browser: 'ServerConnection', changed: asyncio.Event) -> None:
        """Send the newest of each kind; waits for a slow browser, and then skips what is old."""
        number = 0
        try:
            while True:
                changed.clear()
                number, contents = self._board.since(number)
                for kind, content in contents.items():
                    if isinstance(content, bytes):
                        content = kind.encode() + b'\0' + content
                    await browser.send(content)
                await changed.wait()
        except ConnectionClosed:
            pass


def is_loopback(host: str) -> bool:
    """Return whether a name or address leads to this machine alone."""
    if host == 'localhost':
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def message(kind: str, text: str) -> str:
    """Return a message of text for browsers."""
    return json.dumps({'kind': kind, 'text': text})


def _page(status: HTTPStatus, body: str | bytes, kind: str = 'text/plain') -> Response:
    """Return a whole answer."""
    content = body.encode() if isinstance(body, str) else body
    return Response(status.value, status.phrase, Headers({
        'Content-Type': f'{kind}; charset=utf-8', 'Content-Length': str(len(content)),
        'Content-Security-Policy': _POLICY, 'X-Content-Type-Options': 'nosniff',
        'Referrer-Policy': 'no-referrer', 'Cache-Control': 'no-store',
        'Connection': 'close'}), content)
