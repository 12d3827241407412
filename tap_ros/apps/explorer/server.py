# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The WebSockets of the explorer's page: what is new goes out, commands come in."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from http import HTTPStatus
import json
import socket
import threading
import time
from typing import Any

from tap_ros.apps.server import Handler, PageServer, refused
from tap_ros.base.errors import TapError
from websockets.datastructures import Headers
from websockets.exceptions import InvalidState
from websockets.frames import CloseCode, DATA_OPCODES, Frame
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

MAX_COMMAND = 4096  # bytes
MAX_BROWSERS = 64
PING_S = 20.0  # a browser that is silent is asked, and has as long to answer
_GOODBYE_S, _POLL_S = 1.0, 0.1


class ExplorerServer(PageServer):
    """
    Shows browsers the newest of each kind of content, and takes their commands.

    Nothing is queued: who is slow misses what was replaced meanwhile, and gets the newest. It
    answers from the start, in threads of its own.

    :param on_command: called with the text of each command, in the browser's thread. A TapError
        that it raises is told to the browser that asked.
    :param host: and the others: see PageServer.
    """

    def __init__(self, on_command: Callable[[bytes], object], host: str = '127.0.0.1',
                 port: int = 8000, token: str = '') -> None:
        super().__init__('explorer/page', host, port, token)
        self._on_command = on_command
        self._contents: dict[str, tuple[int, str | bytes]] = {}  # kind -> (number, content)
        self._count = 0  # of changes
        self._changed = threading.Condition()  # guards these and the browsers
        self._browsers: set[Browser] = set()
        threading.Thread(target=self.serve_forever, args=(_POLL_S,), name='explorer',
                         daemon=True).start()

    @property
    def browsers(self) -> int:
        """How many are connected."""
        return len(self._browsers)

    def put(self, kind: str, content: str | bytes) -> None:
        """Replace the content of a kind; an equal one changes nothing. From any thread."""
        with self._changed:
            if self._contents.get(kind, (0, None))[1] != content:
                self._count += 1
                self._contents[kind] = self._count, content
                self._changed.notify_all()

    def close(self) -> None:
        """Say goodbye to all browsers and free the port."""
        for browser in list(self._browsers):
            browser.close()
        self.shutdown()
        self.server_close()
        with self._changed:
            self._changed.wait_for(lambda: not self._browsers, _GOODBYE_S)
        for browser in list(self._browsers):
            browser.end()

    def converse(self, request: Handler) -> None:
        """Send what changes and take commands until the browser goes."""
        browser = Browser(request, lambda: self.ends.setdefault(
            request.connection, time.monotonic() + _GOODBYE_S))
        with self._changed:
            if room := len(self._browsers) < MAX_BROWSERS:
                self._browsers.add(browser)
        try:
            if not room:
                request.send(refused(HTTPStatus.SERVICE_UNAVAILABLE,
                                     'Too many browsers are connected.'))
            elif browser.open():
                self.ends.pop(request.connection)  # it may last
                threading.Thread(target=self._send_news, args=(browser,), daemon=True).start()
                for command in browser.messages():
                    try:
                        self._on_command(command)
                    except TapError as error:
                        browser.send(json.dumps({'kind': 'error', 'text': str(error)}))
        finally:
            with self._changed:
                self._browsers.discard(browser)
                self._changed.notify_all()

    def _send_news(self, browser: 'Browser') -> None:
        """Send the newest of each kind, the oldest change first, to a browser that may be slow."""
        sent = 0
        while True:
            with self._changed:
                while self._count == sent and browser in self._browsers:
                    self._changed.wait()
                if browser not in self._browsers:
                    return
                new = sorted((number, kind, content) for kind, (number, content)
                             in self._contents.items() if number > sent)
                sent = self._count
            for _, kind, content in new:
                browser.send(content if isinstance(content, str)
                             else kind.encode() + b'\0' + content)


class Browser:
    """
    A WebSocket; who does not answer, or takes nothing, for too long is let go.

    :param request: that asks for it.
    :param on_closing: called when it is about to end.
    """

    def __init__(self, request: Handler, on_closing: Callable[[], object]) -> None:
        self._socket, self._on_closing = request.connection, on_closing
        self._socket.settimeout(PING_S)
        self._lock = threading.RLock()  # of the protocol, and of what is sent
        self._protocol = ServerProtocol(max_size=MAX_COMMAND)
        self._request = Request(request.path, Headers(request.headers.items())).serialize()
        request.close_connection = True  # no other request comes after this one

    def open(self) -> bool:
        """Shake hands; return whether that succeeded."""
        for request in self._do(partial(self._protocol.receive_data, self._request)):
            self._do(partial(self._protocol.send_response, self._protocol.accept(request)))
        return self._protocol.state is State.OPEN

    def messages(self) -> Iterator[bytes]:
        """Yield what comes, until the end."""
        message, silent = b'', False
        while True:
            try:
                data = self._socket.recv(2 ** 16)
            except TimeoutError:
                if silent:
                    return
                silent = True
                self._do(lambda: self._protocol.send_ping(b''))
                continue
            if not data:
                return
            silent = False
            for frame in self._do(partial(self._protocol.receive_data, data)):
                if isinstance(frame, Frame) and frame.opcode in DATA_OPCODES:
                    message += frame.data
                    if frame.fin:
                        yield message
                        message = b''

    def send(self, content: str | bytes) -> None:
        """Send a message; nothing once the browser goes."""
        try:
            self._do(partial(self._protocol.send_text, content.encode())
                     if isinstance(content, str) else
                     partial(self._protocol.send_binary, content))
        except InvalidState:
            pass
        except OSError:
            self.end()

    def close(self) -> None:
        """Say goodbye, unless something is on its way that takes long."""
        if self._lock.acquire(timeout=_POLL_S):
            with suppress(OSError, InvalidState):
                self._do(partial(self._protocol.send_close, CloseCode.GOING_AWAY))
            self._lock.release()

    def end(self) -> None:
        """End the connection."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _do(self, step: Callable[[], object]) -> list[Any]:
        """Take a step of the protocol, send what it wants sent, and return what has come."""
        with self._lock:
            step()
            for data in self._protocol.data_to_send():
                if data:
                    self._socket.sendall(data)
                else:
                    self._socket.shutdown(socket.SHUT_WR)
            if self._protocol.close_expected():
                self._on_closing()
            return self._protocol.events_received()
