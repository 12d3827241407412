# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the explorer's server, over real sockets of this machine, and of its parts."""

from contextlib import contextmanager, ExitStack
import http.client
import json
import math
import socket
import threading
import time

import cv2
import numpy as np
from processes import Client, LocalNode, Newest, until
import pytest
from sensor_msgs.msg import CompressedImage, Image
from tap_msgs.msg import ObjectStates
from tap_ros.apps.explorer import command as explore
from tap_ros.apps.explorer import node as explorer_node
from tap_ros.apps.explorer.browser_commands import CommandError, parse_command
from tap_ros.apps.explorer.display import GoalByHand
from tap_ros.apps.explorer.node import ExplorerNode
from tap_ros.apps.explorer.server import ExplorerServer, MAX_BROWSERS, MAX_COMMAND
from tap_ros.apps.server import is_loopback
from tap_ros.base.contract import CAMERA_FRAME, WORLD_FRAME
from tap_ros.base.errors import ConfigError
from tap_ros.ros.calls import CallError
from tap_ros.ros.topics import encode_image, encode_objects, LATCHED, STREAM, to_stamp
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
    connection = http.client.HTTPConnection('127.0.0.1', server.port, timeout=60)
    connection.request('GET', path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body


def browse(server, query='', **headers):
    return connect(f'ws://127.0.0.1:{server.port}/socket{query}', additional_headers=headers,
                   open_timeout=60, close_timeout=2, compression=None, max_size=2**25)


def test_browsers_get_all_that_is_there_then_what_changes_and_errors_of_their_own():
    with serving() as server:
        server.put('camera', b'an older picture')
        server.put('state', '{"kind": "state"}')
        server.put('camera', b'a picture')
        with browse(server) as browser, browse(server) as other:
            for each in (browser, other):
                assert [each.recv(60) for _ in '12'] == ['{"kind": "state"}', b'camera\0a picture']
            server.put('state', '{"kind": "state"}')  # no change
            server.put('camera', b'another')
            assert browser.recv(60) == other.recv(60) == b'camera\0another'
            browser.send('{"do": "cancel"}')
            for text in ('{"do": "fly"}', '{"do": "\\ud800"}',
                         '{"do": "reset", "seed": 0, "task": "\\udfff\\ud800"}'):
                browser.send(text)
                answer = json.loads(browser.recv(60))
                assert answer['kind'] == 'error' and ': expected' in answer['text']
            assert len(server.commands) == 1
            server.put('state', '{}')
            assert other.recv(60) == '{}', 'others are not told'


def test_a_slow_browser_holds_up_nobody_and_gets_the_newest():
    with serving() as server, browse(server) as slow, browse(server) as quick:
        for i in range(200):
            server.put('camera', bytes([i]) * 200_000)
            if i % 10 == 9:
                last = quick.recv(60)
        assert until(lambda: quick.recv(60)[7] == 199 if last[7] != 199 else True)
        seen = [slow.recv(60)[7]]
        while seen[-1] != 199:
            seen.append(slow.recv(60)[7])
        assert len(seen) < 200, 'what was replaced is not sent'


def test_browsers_that_leave_vanish_say_too_much_or_are_too_many_leave_nothing_behind():
    with serving() as server:
        threads = threading.active_count()
        with ExitStack() as browsers:
            for _ in range(MAX_BROWSERS):
                browsers.enter_context(browse(server))
            with pytest.raises(InvalidStatus, match='503'), browse(server):
                pass
        assert until(lambda: server.browsers == 0)
        with browse(server) as browser:
            assert until(lambda: server.browsers == 1)
            browser.socket.shutdown(socket.SHUT_RDWR)
            assert until(lambda: server.browsers == 0)
        with browse(server) as browser, pytest.raises(ConnectionClosed):
            browser.send('x' * (MAX_COMMAND + 1))
            browser.recv(60)
        assert until(lambda: server.browsers == 0 and threading.active_count() <= threads)


def test_a_browser_that_answers_nothing_or_takes_nothing_is_let_go(monkeypatch):
    monkeypatch.setattr('tap_ros.apps.explorer.server.PING_S', 1.0)
    hello = '\r\n'.join((
        'GET /socket HTTP/1.1', 'Host: 127.0.0.1', 'Upgrade: websocket', 'Connection: Upgrade',
        'Sec-WebSocket-Version: 13', 'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==', '', ''))
    with serving() as server, browse(server) as answering:
        for content in (b'', b'x' * 2**24):
            with socket.create_connection(('127.0.0.1', server.port)) as silent:
                silent.sendall(hello.encode())
                assert until(lambda: server.browsers == 2)
                server.put('camera', content)
                assert until(lambda: server.browsers == 1)
            assert answering.recv(60) == b'camera\0' + content


def test_foreign_pages_and_foreign_names_that_lead_here_are_refused():
    with serving() as server:
        for path, words in (('/', b'<canvas id="large"'), ('/explorer.js', b'WebSocket'),
                            ('/shared.js', b'getElementById')):
            status, headers, body = get(server, path)
            assert status == 200 and words in body
            assert "script-src 'self'" in headers['Content-Security-Policy']
        assert get(server, '/../../setup.py')[0] == get(server, '/nothing')[0] == 404
        for origin in ('http://evil.example', f'http://evil.example:{server.port}', 'null'):
            with pytest.raises(InvalidStatus, match='403'), browse(server, Origin=origin):
                pass
        with browse(server, Origin=f'http://127.0.0.1:{server.port}'):
            pass
        assert get(server, Host=f'evil.example:{server.port}')[0] == 403
        for host in ('localhost', '127.9.9.9', '[::1]'):
            assert get(server, Host=f'{host}:{server.port}')[0] == 200
    assert not any(map(is_loopback, ('0.0.0.0', '192.168.0.1', 'localhost.evil.example', '')))


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


def test_addresses_that_cannot_be_had_are_named_and_what_ends_frees_its_port():
    with serving() as server, pytest.raises(ConfigError, match=f'port.*{server.port}'):
        ExplorerServer(print, port=server.port)
    for host in ('', 'a\0b', 'no.such.host.invalid'):
        with pytest.raises(ConfigError, match='host'):
            ExplorerServer(print, host=host, port=0)
    with ExitStack() as stack:
        with serving() as server:
            browser = stack.enter_context(browse(server))
        with pytest.raises(ConnectionClosed):
            browser.recv(60)
    ExplorerServer(print, port=server.port).close()


# Commands, without sockets

REACH = {'do': 'reach', 'mode': 'direct'}
RESET = {'do': 'reset', 'task': 'push2', 'seed': 7}
MOVE = {'do': 'move', 'name': 'object_0', 'u': 3, 'v': 4.5}
CUP = {'name': 'cup', 'u': 3, 'v': 4.5}
SELECT = {'do': 'select', 'objects': [CUP, {**CUP, 'name': 'ring'}]}


def test_beside_another_explorer_no_node_is_started(tmp_path):
    with socket.create_server(('127.0.0.1', 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f'127.0.0.1:{port}.*another port.*ROS_DOMAIN_ID'):
            explore.run(explore.Options(port=port, logs=str(tmp_path / 'logs')))
    with pytest.raises(ConfigError, match='99999'):
        explore.run(explore.Options(port=99999, logs=str(tmp_path / 'logs')))
    assert not (tmp_path / 'logs').exists()


def test_a_command_reads_as_it_is_meant_and_what_makes_no_sense_is_refused_by_the_fields_name():
    for command in (REACH, RESET, MOVE, SELECT, *({'do': do} for do in (
            'cancel', 'photograph', 'predict', 'propose'))):
        do, fields = parse_command(json.dumps({**command, 'other': 1}).encode())
        assert {'do': do, **fields} == command
    for text in ('', '[]', b'\xff\xfe', '[' * 5000):
        with pytest.raises(CommandError, match='JSON'):
            parse_command(text)
    large = int('9' * 400)
    for command, name, values in (
            (RESET, 'do', ('shutdown', ['reach'], '\ud800')),
            (RESET, 'task', (3, 'x' * 101, 'a\nb')),
            (RESET, 'seed', (-1, True, 1e300, large)), (REACH, 'mode', ('', 3)),
            (MOVE, 'u', (math.nan, large)), (MOVE, 'v', ('1',)),
            (MOVE, 'name', ('a\udc80', '\ud83d')),
            (SELECT, 'objects', (
                [], [3], [{'name': 'cup', 'u': 3}], [{**CUP, 'u': '3'}], 33 * [CUP]))):
        for value in values:
            with pytest.raises(CommandError, match=name) as refused:
                parse_command(json.dumps({**command, name: value}))
            assert str(refused.value).isprintable()


# Beside a real camera, where no simulator takes goal pictures


def problem_of(browser):
    """Return the newest thing that could not be done, once there is one."""
    problem = {'count': 0}
    while not problem['count']:
        text = browser.recv(10)
        if isinstance(text, str):
            problem = json.loads(text).get('problem', problem)
    return problem['text']


@pytest.mark.parametrize('transport', ['raw', 'compressed'])
def test_a_photograph_of_a_real_camera_becomes_the_goal(transport):
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    with ExitStack() as stack:
        explorer = LocalNode(
            ExplorerNode, port=0, token='secret', image_transport=transport)
        stack.callback(explorer.end)
        node = stack.enter_context(Client('camera'))
        pictures = node.create_publisher(
            *((Image, 'camera/image_raw') if transport == 'raw' else
              (CompressedImage, 'camera/image_raw/compressed')), STREAM)
        goal_image = Newest(node, Image, 'goal/image', LATCHED)
        goal_objects = Newest(node, ObjectStates, 'goal/objects', LATCHED)
        url = explorer.node.url.replace('http', 'ws').replace('/?', '/socket?')
        assert url.endswith('?token=secret')
        browser = stack.enter_context(connect(url, open_timeout=60))
        browser.send('{"do": "photograph"}')
        assert problem_of(browser) == 'no goal picture: the camera is silent; no picture to take'
        assert until(pictures.get_subscription_count)
        message = encode_image(image, to_stamp(10**9), CAMERA_FRAME)
        if transport == 'compressed':
            data = cv2.imencode('.png', image[..., ::-1])[1].tobytes()
            message = CompressedImage(header=message.header, format='png', data=data)
        pictures.publish(message)
        while not (isinstance(text := browser.recv(10), bytes) and text.startswith(b'camera\0')):
            pass
        browser.send('{"do": "photograph"}')
        goal = goal_image.wait(10)
        assert bytes(goal.data) == image.tobytes() and goal.header == message.header
        assert not goal_objects.wait(10).objects, 'not those of another goal'


def test_what_is_sent_again_and_again_is_encoded_once_and_plugins_are_looked_for_once(monkeypatch):
    made = []
    for name in ('picture_bytes', 'names'):
        asked = getattr(explorer_node, name)
        monkeypatch.setattr(explorer_node, name, lambda *what, name=name, asked=asked: (
            made.append(name), asked(*what))[1])
    explorer = LocalNode(ExplorerNode, port=0)
    picture = encode_image(np.zeros((12, 16, 3), np.uint8), to_stamp(5), CAMERA_FRAME)
    with Client('camera') as node, browse(explorer.node._server):
        publisher = node.create_publisher(Image, 'camera/image_raw', STREAM)
        assert until(publisher.get_subscription_count)
        for count, stamp in enumerate((5, 6), 1):
            picture.header.stamp = to_stamp(stamp)
            for _ in range(10):
                publisher.publish(picture)
                time.sleep(0.1)
            assert until(lambda count=count: made.count('picture_bytes') == count)
    assert explorer.end() == 0
    assert sorted(made) == ['names', 'picture_bytes', 'picture_bytes']


def test_goals_placed_by_hand_leave_the_others_and_belong_to_their_picture():
    def message(stamp, **places):
        """Return objects that a tracker follows: (u, v, state) of each."""
        u, v, states = zip(*places.values())
        found = encode_objects(places, np.column_stack([u, v]), None, to_stamp(stamp),
                               WORLD_FRAME, ObjectStates.SOURCE_TRACKED)
        found.states, found.confidence = states, [0.5] * len(u)
        return found

    placed = []
    with Client('hand') as node:
        hand = GoalByHand(node)
        hand._publish = lambda message, topic: placed.append(message)
        newest = {'objects': message(5, cup=(1.0, 2.0, 'seen'), ring=(3.0, 4.0, 'hidden'))}

        def place(name, *pixel):
            hand.place(name, pixel, newest)
            newest['goal_objects'] = placed[-1]
            return {one.name: (one.u, one.v, state) for one, state in zip(
                placed[-1].objects, placed[-1].states)}

        assert place('cup', 9.0, 9.0) == {'cup': (9.0, 9.0, 'seen'), 'ring': (3.0, 4.0, 'hidden')}
        assert place('ring', 8.0, 8.0)['cup'] == (9.0, 9.0, 'seen')
        newest['goal'] = Image()
        newest['goal'].header.stamp = to_stamp(7)
        assert place('ring', 6.0, 6.0) == {'ring': (6.0, 6.0, 'seen')}, 'another picture'
        assert placed[-1].header.stamp == to_stamp(7)
        newest['goal_objects'] = message(7, cup=(1.0, 2.0, 'lost'), ring=(3.0, 4.0, 'seen'))
        assert place('ring', 5.0, 5.0)['cup'] == (1.0, 2.0, 'lost'), 'was not found there'
        with pytest.raises(CallError, match='cup, ring'):
            hand.place('plate', (1.0, 1.0), newest)
