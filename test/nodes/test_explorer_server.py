# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer's server, over real sockets of this machine."""

from contextlib import contextmanager, ExitStack
import http.client
import json
import socket
import threading

from hypothesis import given, settings
from hypothesis import strategies as st
from processes import http_status, until
import pytest
from tap_ros.errors import ConfigError
from tap_ros.nodes.explorer.calls import parse_command
from tap_ros.nodes.explorer.server import ExplorerServer, is_loopback, MAX_BROWSERS, MAX_COMMAND
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect


@contextmanager
def serving(**options):
    """Serve; the commands are in server.commands."""
    commands = []
    server = ExplorerServer(lambda text: commands.append(parse_command(text)), port=0, **options)
    server.commands = commands
    try:
        yield server
    finally:
        server.close()


def get(server, path='/', **headers):
    """Return status, headers and body of an answer."""
    connection = http.client.HTTPConnection('127.0.0.1', server.port, timeout=10)
    connection.request('GET', path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body


def browse(server, query='', **headers):
    return connect(f'ws://127.0.0.1:{server.port}/socket{query}', additional_headers=headers,
                   open_timeout=10, close_timeout=2, compression=None)


def test_the_page_its_script_and_its_style_are_served():
    with serving() as server:
        for path, words in (('/', b'<canvas id="goal"'), ('/explorer.js', b'WebSocket'),
                            ('/explorer.css', b'canvas')):
            status, headers, body = get(server, path)
            assert status == 200 and words in body
            assert "script-src 'self'" in headers['Content-Security-Policy']
        assert get(server, '/../../setup.py')[0] == get(server, '/nothing')[0] == 404


def test_browsers_get_all_that_is_there_then_what_changes_and_errors_of_their_own():
    with serving() as server:
        server.put('camera', b'an older picture')
        server.put('state', '{"kind": "state"}')
        server.put('camera', b'a picture')
        with browse(server) as browser, browse(server) as other:
            for each in (browser, other):
                assert [each.recv(5), each.recv(5)] == ['{"kind": "state"}', b'camera\0a picture']
            server.put('state', '{"kind": "state"}')  # no change
            server.put('camera', b'another')
            assert browser.recv(5) == other.recv(5) == b'camera\0another'
            browser.send('{"do": "cancel"}')
            for text in ('{"do": "fly"}', '{"do": "\\ud800"}',
                         '{"do": "reset", "seed": 0, "task": "\\udfff\\ud800"}'):
                browser.send(text)
                answer = json.loads(browser.recv(5))
                assert answer['kind'] == 'error' and ': expected' in answer['text']
            assert len(server.commands) == 1
            server.put('state', '{}')
            assert other.recv(5) == '{}', 'others are not told'


def test_a_slow_browser_holds_up_nobody_and_gets_the_newest():
    with serving() as server, browse(server) as slow, browse(server) as quick:
        for i in range(200):
            server.put('camera', bytes([i]) * 200_000)
            if i % 10 == 9:
                last = quick.recv(5)
        assert until(lambda: quick.recv(5)[7] == 199 if last[7] != 199 else True)
        seen = [slow.recv(5)[7]]
        while seen[-1] != 199:
            seen.append(slow.recv(5)[7])
        assert len(seen) < 200, 'what was replaced is not sent'


def test_browsers_that_leave_vanish_or_say_too_much_leave_nothing_behind():
    with serving() as server:
        threads = threading.active_count()
        for _ in range(20):
            with browse(server):
                pass
        with browse(server) as browser:
            assert until(lambda: server.browsers == 1)
            browser.socket.shutdown(socket.SHUT_RDWR)
            assert until(lambda: server.browsers == 0)
        with browse(server) as browser, pytest.raises(ConnectionClosed):
            browser.send('x' * (MAX_COMMAND + 1))
            browser.recv(5)
        assert until(lambda: server.browsers == 0 and threading.active_count() <= threads)


def test_addresses_and_headers_that_cannot_be_read_are_refused_and_nothing_else():
    host = b'Host: localhost'
    with serving(token='secret') as locked, serving() as server:
        for target, *headers in (
                (b'//[', host), (b'http://[::1', host), (b'/socket//[', host),
                (b'/', b'Host: ['), (b'/', b'Host: [::1'), (b'/', host, b'Origin: http://[')):
            assert http_status(server.port, target, *headers) in (400, 403, 404), (target, headers)
        assert http_status(locked.port, b'/?token=\xff\xfe', host) in (None, 400, 401)
        assert http_status(locked.port, b'/?token=%ED%A0%80', host) == 401

        @settings(max_examples=60)
        @given(st.binary(max_size=12), st.binary(max_size=12), st.binary(max_size=12))
        def refused(path, name, origin):
            for each in (server, locked):
                clean = [part.translate(None, b'\r\n\0 \t') for part in (path, name, origin)]
                found = http_status(each.port, b'/' + clean[0], b'Host: ' + clean[1] + b'[',
                                  b'Origin: //[' + clean[2])
                assert found in (None, 400, 403), found
        refused()
        assert get(server)[0] == 200


def test_foreign_pages_and_foreign_names_that_lead_here_are_refused():
    with serving() as server:
        for origin in ('http://evil.example', f'http://evil.example:{server.port}', 'null'):
            with pytest.raises(InvalidStatus, match='403'), browse(server, Origin=origin):
                pass
        with browse(server, Origin=f'http://127.0.0.1:{server.port}'):
            pass
        assert get(server, Host=f'evil.example:{server.port}')[0] == 403
        for host in ('localhost', '127.0.0.1', '[::1]'):
            assert get(server, Host=f'{host}:{server.port}')[0] == 200


def test_a_token_is_asked_for_by_page_and_socket_and_stands_in_the_address():
    for options in ({'token': 'a token'}, {'token': 'a&b c#d/?='}, {'host': '0.0.0.0'}):
        with serving(**options) as server:
            path = server.url.removeprefix(
                f'http://{options.get("host", "127.0.0.1")}:{server.port}')
            assert ' ' not in path and len(path) > 10
            assert get(server, path)[0] == get(server, path, Host='robot.example:1')[0] == 200
            assert get(server)[0] == get(server, '/?token=wrong')[0] == 401
            with pytest.raises(InvalidStatus, match='401'), browse(server):
                pass
            with browse(server, path.removeprefix('/')):
                pass


def test_so_many_browsers_and_no_more():
    with serving() as server:
        with ExitStack() as browsers:
            for _ in range(MAX_BROWSERS):
                browsers.enter_context(browse(server))
            with pytest.raises(InvalidStatus, match='503'), browse(server):
                pass
        assert until(lambda: server.browsers == 0)
        with browse(server):
            pass


def test_addresses_that_cannot_be_had_are_named_and_what_ends_frees_its_port():
    with serving() as server, pytest.raises(ConfigError, match=f'port.*{server.port}'):
        ExplorerServer(print, port=server.port)
    for host in ('', 'a' * 70, 'a\0b', '256.0.0.1', 'no.such.host.invalid'):
        with pytest.raises(ConfigError, match='host'):
            ExplorerServer(print, host=host, port=0)
    with ExitStack() as stack:
        with serving() as server:
            browser = stack.enter_context(browse(server))
        with pytest.raises(ConnectionClosed):
            browser.recv(5)
    ExplorerServer(print, port=server.port).close()


def test_what_leads_to_this_machine_alone():
    for host, mine in (
            ('localhost', True), ('127.0.0.1', True), ('127.9.9.9', True), ('::1', True),
            ('0.0.0.0', False), ('192.168.0.1', False), ('localhost.evil.example', False),
            ('', False)):
        assert is_loopback(host) == mine
