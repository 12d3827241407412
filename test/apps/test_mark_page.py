# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the page that marks: what it shows, proposes, keeps and refuses."""

from contextlib import contextmanager, suppress
from dataclasses import replace
import json
from pathlib import Path
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from browsing import chromium, hidden_or_over, needs_browser, opened
import cv2
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.apps.label_command import Options, WholeReading
from tap_ros.apps.mark_command import MarkServer, parse_names, words_of
from tap_ros.apps.mark_labels import BackgroundLabels
from tap_ros.apps.marking import Marking
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import only_keeper
from tap_ros.base.options import parse
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.full_size import FullSize
from tap_ros.recording.gripper_moves import gripper_moves
from tap_ros.recording.marks import read_marks, write_marks
from tap_ros.recording.reading import Reading

COUNT, WIDE, HIGH = 14, 96, 72


def make_episode(i):
    """Draw 9 to 13 frames of two squares, and of a gripper that closes at 3 and opens at 6."""
    rng = np.random.default_rng(i)
    start = rng.uniform(10, 50, (2, 2))
    one = move_squares(start, start + rng.uniform(5, 15, (2, 2)), 9 + i % 5, WIDE, 4, i)
    grippers = np.zeros((len(one), 4), np.float32)
    grippers[:, 3] = np.interp(np.arange(len(one)), [2, 3, 5, 6], [1, .2, .2, 1])
    return replace(one, frames=np.ascontiguousarray(one.frames[:, :HIGH]), grippers=grippers,
                   goal_frame=np.ascontiguousarray(one.frames[-1, :HIGH]))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('bags') / 'squares', map(make_episode, range(COUNT)))


@pytest.fixture
def store(bag):
    return open_recordings([bag], progress=False, reading=Reading(crop='whole', size=64))


@contextmanager
def serving(marking, **options):
    """Serve a page; return what asks it."""
    server = MarkServer(marking, **options)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()

    def ask(place, data=None, **headers):
        return urlopen(Request(f'http://127.0.0.1:{server.port}/{place}', data, headers))

    try:
        yield ask
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def page(bag, store, tmp_path):
    """Serve the page; return what asks it, and the file it writes."""
    path = tmp_path / 'marks.json'
    with serving(Marking(store, [str(bag)], path)) as ask:
        yield ask, path


def put(ask, episode, frames, wait=True):
    """Mark an episode; return the state, once labels are no longer being found where to wait."""
    state = json.load(ask('mark', json.dumps({'episode': episode, 'frames': frames}).encode()))
    while wait and state['busy']:
        time.sleep(0.02)
        state = json.load(ask('state'))
    return state


def test_the_page_ends_with_an_interrupt_as_it_should(bag, tmp_path):
    with subprocess.Popen(
            [sys.executable, '-m', 'tap_ros', 'mark', str(bag), '--names', 'grasp', '--port', '0',
             '--marks', str(tmp_path / 'marks.json')], text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        assert 'Ctrl-C ends' in command.stdout.readline()
        command.send_signal(signal.SIGINT)
        assert command.wait(30) == 0
        assert 'Traceback' not in command.stderr.read()


def test_marks_are_written_at_once_and_what_is_refused_changes_nothing(page, bag, store):
    ask, path = page
    assert b'mark.js' in ask('').read() and b'ArrowLeft' in ask('mark.js').read()
    state = json.load(ask('state'))
    assert state['lengths'] == store.lengths.tolist() and state['order'][:2] == [0, COUNT - 1]
    visited = []
    while state['order']:
        visited.append(state['order'][0])
        state = put(ask, visited[-1], [4, 2], wait=False)
        assert read_marks(path, store).episodes[visited[-1]] == [(2, 2), (4, 4)]
        assert state['marks'][str(visited[-1])] == [2, 4]
    assert sorted(visited) == list(range(COUNT)) and 4 < visited[2] < 10  # far from those before
    state = put(ask, 5, [], wait=False)
    assert state['order'] == [5] and 5 not in read_marks(path, store).episodes
    again = Marking(store, [str(bag)], path).state()
    assert json.loads(json.dumps(again))['marks'] == state['marks']
    before = path.read_bytes()
    for place, data, headers, code in (
            ('mark', b'{"episode": 1, "frames": [0]}', {}, 400), ('mark', b'x', {}, 400),
            ('mark', b'{"episode": 1, "frames": ""}', {}, 400), ('mark', b'[' * 60000, {}, 400),
            ('mark', b'{"episode": 1, "frames": [true, 2]}', {}, 400),
            ('mark', b'{"episode": true, "frames": [2]}', {}, 400),
            ('mark', b' ' * 70000, {}, 413), ('mark', b'', {'Content-Length': '-1'}, 413),
            (f'frame/{"9" * 5000}/0', None, {}, 404), ('frame/0', None, {}, 404),
            ('about/0/0', None, {}, 404), ('about/x', None, {}, 404), ('about', None, {}, 404),
            ('small/0/99', None, {}, 404), ('frame/-1/0', None, {}, 404),
            ('mark', b'{"episode": 1, "frames": [1]}', {'Origin': 'http://evil.example'}, 403),
            ('state', None, {'Host': 'evil.example'}, 403), ('frame/99/0', None, {}, 404),
            ('../setup.py', None, {}, 404)):
        with pytest.raises(HTTPError) as error:
            ask(place, data, **headers)
        assert error.value.code == code, (place, data)
    assert path.read_bytes() == before
    path.with_name(f'{path.name}.part').mkdir()  # nothing can be written
    with pytest.raises(HTTPError) as error:
        ask('mark', b'{"episode": 1, "frames": [1, 2]}')
    assert error.value.code == 507 and b'cannot be written' in error.value.read()
    assert json.load(ask('state'))['marks'] == state['marks']


def test_pictures_are_shown_as_they_were_recorded(page, bag, store):
    ask, _ = page
    recorded = open_recordings([bag], progress=False)

    def shown(place):
        return cv2.imdecode(np.frombuffer(ask(place).read(), np.uint8), cv2.IMREAD_COLOR_RGB)

    assert shown('small/3/2').shape == (64, 64, 3)
    for i, t in ((0, 0), (3, 2), (COUNT - 1, 5)):
        assert (shown(f'frame/{i}/{t}') == recorded.frames(i)[t]).all()
    part = FullSize(store, '10,0,40').picture(3, 2)
    assert (part == recorded.frames(3)[2][:40, 10:50]).all()


def test_a_recording_that_is_gone_is_shown_as_small_as_it_is_kept(bag, tmp_path):
    copy = write_bag(tmp_path / 'copy', [make_episode(0)])
    store = open_recordings([copy], progress=False, reading=Reading(crop='whole', size=64))
    pictures = FullSize(store)
    assert pictures.picture(0, 1).shape == (HIGH, WIDE, 3)
    file, = copy.glob('*.mcap')
    file.write_bytes(file.read_bytes()[:-20])  # as of a recorder that was killed: no index
    store = open_recordings([copy], progress=False, reading=Reading(crop='whole', size=64))
    assert FullSize(store).picture(0, 1).shape == (64, 64, 3)
    store = open_recordings([copy], progress=False, reading=Reading(crop='whole', size=64))
    file.unlink()
    assert FullSize(store).picture(0, 1).shape == (64, 64, 3)


def test_the_least_certain_label_comes_next_once_three_are_marked(page, store):
    ask, _ = page
    for i, frames in ((0, [4]), (COUNT - 1, [4, 5])):
        assert not put(ask, i, frames)['labels']
    assert not put(ask, 3, [4])['labels'], 'marks of different numbers tell nothing together'
    state = put(ask, COUNT - 1, [4])
    assert {*state['labels']} == {str(i) for i in state['order']} == {
        str(i) for i in range(COUNT) if i not in (0, 3, COUNT - 1)}
    sure = [state['labels'][str(i)][0][1] for i in state['order']]
    assert sure == sorted(sure) and 0 < sure[0] < 1
    assert all(0 < state['labels'][str(i)][0][0] < store.lengths[i] - 1 for i in state['order'])
    assert not put(ask, 0, [])['labels']


def test_marks_with_names_are_complete_and_in_their_order(bag, store, tmp_path):
    path = tmp_path / 'marks.json'
    marking = Marking(store, [str(bag)], path, ['grasp', 'release'])
    for frames in ([3], [6, 3], [3, 3], [2, 3, 4]):
        with pytest.raises(ConfigError, match='each of grasp, release, in this order'):
            marking.mark(2, frames)
    assert not path.exists()
    marking.mark(2, [3, 6])
    assert read_marks(path, store).names == ('grasp', 'release')
    assert Marking(store, [str(bag)], path).names == ('grasp', 'release')
    for names in (['release', 'grasp'], ['a', 'b'], ['grasp']):  # else marks change their meaning
        with pytest.raises(ConfigError, match='names: .* are grasp, release; leave --names out'):
            Marking(store, [str(bag)], path, names)
    path.write_text(path.read_text().replace('"names": ["grasp", "release"], ', ''))
    with pytest.raises(ConfigError, match='names: grasp, but demonstration 2 has 2 marks'):
        Marking(store, [str(bag)], path, ['grasp'])
    assert parse_names('grasp, release') == ['grasp', 'release'] and parse_names('') == []
    for text in ('a,,b', 'a,a', ',', ','.join('abcdefghij')):
        with pytest.raises(ConfigError, match='^names: expected 1 to 9 different'):
            parse_names(text)


def test_what_is_marked_is_no_label_any_more(bag, store, tmp_path):
    path = tmp_path / 'marks.json'
    write_marks(path, store, [bag], {0: [(1, 1)], 1: [(1, 1)]}, labels={0, 1})
    Marking(store, [str(bag)], path).mark(0, [2])
    assert read_marks(path, store).labels == {1}


def test_a_gripper_that_was_recorded_proposes_moments(page):
    ask, _ = page
    about = json.load(ask('about/4'))
    assert about['moves'] == [[3, True], [6, False]] and about['seconds'][:3] == [0, 0.25, 0.5]
    one = make_episode(4)
    unknown = np.full_like(one.grippers, np.nan)
    commands = np.append(one.grippers[1:], np.zeros((1, 4), np.float32), 0)
    assert gripper_moves(replace(one, grippers=unknown, actions=commands)) == [
        (2, True), (5, False)]
    nothing = replace(one, grippers=unknown, actions=unknown)
    assert gripper_moves(nothing) == []
    fingers = np.stack([np.arange(len(one)), 2 - one.grippers[:, 3], 3 * one.grippers[:, 3]], 1)
    assert gripper_moves(replace(
        nothing, actions=np.zeros_like(one.actions), signals=fingers.astype(np.float32),
        signal_names=('elbow', 'kHandThumb', 'kHandIndex'))) == [(3, None), (6, None)]
    noise = np.random.default_rng(0).normal(0, 0.01, (len(one), 4)).astype(np.float32)
    assert gripper_moves(replace(one, grippers=noise)) == []
    assert gripper_moves(replace(one, grippers=one.grippers + noise)) == [(3, True), (6, False)]


def test_the_page_names_the_commands_that_come_next(bag, store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('tap_ros.apps.marking.ENOUGH', 2)
    path = tmp_path / 'my marks.json'
    marking = Marking(store, [str(bag)], path, ['grasp', 'release'])
    words = words_of(Reading(('/a', '/b'), rate=4, size=64))
    assert words == ['--image-topic', '/a', '--image-topic', '/b', '--rate', '4']
    for i in range(2):
        assert not marking.commands(words)
        marking.mark(i, [3, 6])
    label, train = map(shlex.split, marking.commands(
        ['--crop', 'centre', '--rate', '4', '--gap', '2.0']))
    assert label == ['python', '-m', 'tap_ros', 'label', str(bag), '--marks', 'my marks.json',
                     '--rate', '4', '--gap', '2.0', '--out', 'labels/squares']
    assert train[3:] == ['train', 'predictor', str(bag), '--marks', 'my marks.json', '--crop',
                         'centre', '--rate', '4', '--gap', '2.0', '--size', '64', '--recursion',
                         '2', '--keyframes', '--no-new-pixels', '--test-fraction', '0.25',
                         '--threads', '1', '--out', 'runs/squares']
    one = Marking(store, [str(bag)], tmp_path / 'one.json', ['grasp'])
    for i in range(2):
        one.mark(i, [3])
    page = (Path(__file__).parents[2] / 'docs/first_hour.md').read_text()
    words = one.commands(['--crop', 'centre'])[1].replace(str(bag), 'bags/bottle').replace(
        'one.json', 'bags/bottle.marks.json').replace('runs/squares', 'runs/bottle')
    assert f'\n{words}\n' in page, 'the page of the first hour has this command'
    monkeypatch.setattr('tap_ros.apps.marking.MOST_LEVELS', 2)
    many = Marking(store, [str(bag)], tmp_path / 'many.json')
    for i in range(2):
        many.mark(i, [2, 4, 6])
    assert [shlex.split(line)[3] for line in many.commands([])] == ['label'], 'train would refuse'
    asked = parse(Options, label[4:])
    assert asked.recordings == (str(bag),) and asked.marks == 'my marks.json'
    assert asked.reading == replace(WholeReading(), rate=4, gap=2)


def test_connections_to_the_page_are_few_and_end_in_time(page, monkeypatch):
    ask, _ = page
    place = ask('state').url.split('/')[2].split(':')
    for name, value in (('LONGEST_S', 1e9), ('MAX_CONNECTIONS', 4)):
        monkeypatch.setattr(f'tap_ros.apps.server.{name}', value)
    idle = [socket.create_connection(place) for _ in range(4)]
    with socket.create_connection(place) as one:
        assert one.recv(1) == b''
    for one in idle:
        one.close()
    while True:
        with suppress(OSError):
            assert ask('state').read()
            break
    monkeypatch.setattr('tap_ros.apps.server.LONGEST_S', 0.2)
    with socket.create_connection(place) as slow:
        slow.sendall(b'POST /mark HTTP/1.0\r\nContent-Le')
        assert slow.recv(1) == b''
    assert json.load(ask('state'))


def test_a_second_server_of_a_file_is_refused(bag, tmp_path, capsys):
    path = tmp_path / 'marks.json'
    with only_keeper(path):
        assert main(['mark', str(bag), '--marks', str(path), '--port', '0']) == 1
    assert capsys.readouterr().err.splitlines() == [
        f'error: {path}: another process keeps it; end that one, or choose another file']


@needs_browser
@pytest.mark.slow
def test_what_marks_is_in_sight_at_a_desk_and_on_a_phone_and_keys_press_what_they_are_on(
        bag, store, tmp_path):
    path = tmp_path / 'marks.json'
    marking = Marking(store, [str(bag)], path, ['grasp', 'release'])
    with serving(marking) as ask, chromium() as browser:
        for i, (size, scheme) in enumerate((((1280, 800), 'light'), ((390, 844), 'dark'))):
            with opened(browser, ask('').url, size, color_scheme=scheme) as page:
                page.wait_for_function("about && document.getElementById('now').naturalWidth")
                page.wait_for_function("document.getElementById('goal').naturalWidth")
                assert not hidden_or_over(
                    page, 'header', '#title', '#shown', '#time', '#names', '#accept', '#next')
                before = page.locator('#names button').first.bounding_box()
                page.keyboard.press('ArrowRight')
                page.keyboard.press('1')
                assert 'release not yet' in page.inner_text('#title') and marking.state()[
                    'marks'].keys() == {*range(i)}
                assert page.locator('#names button').first.bounding_box() == before
                page.focus('#accept')  # somebody came there by Tab
                page.keyboard.press('Enter')
                page.wait_for_function(f'Object.keys(state.marks).length === {i + 1}')
                ticks = page.evaluate("""() => [...document.querySelectorAll('#ticks button')]
                    .filter((one) => one.textContent).map((one) => {
                        const {left, right, top} = one.getBoundingClientRect();
                        return [top, left, right];
                    }).sort((a, b) => a[0] - b[0] || a[1] - b[1])""")
                assert len(ticks) > 2 and all(
                    top != other or right <= left
                    for (top, _, right), (other, left, _) in zip(ticks, ticks[1:]))
                shown = page.evaluate('episode')
                page.click('#next')
                page.wait_for_function(f'episode !== {shown}')


def test_labels_that_are_being_found_are_waited_for_at_the_end(store, monkeypatch):
    begun, end, found = (threading.Event() for _ in range(3))

    def find(self, marks, names):
        begun.set()
        assert end.wait(60)
        found.set()
        return {}

    monkeypatch.setattr('tap_ros.apps.mark_labels.BackgroundLabels._find', find)
    labels = BackgroundLabels(store, [0, 1])
    labels.close()  # of a page on which nothing was marked
    labels.ask({0: [3]}, ['grasp'])
    assert begun.wait(10) and not found.is_set()
    labels.ask({0: [4]}, ['grasp'])  # this one is given up
    threading.Timer(0.2, end.set).start()
    labels.close()
    assert found.is_set() and not labels.is_busy


@needs_browser
@pytest.mark.slow
def test_a_hand_that_moves_proposes_nothing_without_labels_and_what_is_marked_stays(
        bag, store, tmp_path, monkeypatch):
    monkeypatch.setattr('tap_ros.apps.marking.gripper_moves', lambda _: [(3, None), (6, None)])
    monkeypatch.setattr('tap_ros.apps.mark_labels.BackgroundLabels._find', lambda self, marks, _: {
        i: [(4, 0.9), (6, 0.8)] for i in self._chosen if i not in marks} if len(marks) > 2 else {})
    marking = Marking(store, [str(bag)], tmp_path / 'marks.json', ['grasp', 'release'])
    with serving(marking) as ask, chromium() as browser, opened(browser, ask('').url) as page:
        page.wait_for_function("about && document.getElementById('now').naturalWidth")
        for k in range(3):
            assert page.evaluate('frame') == 0 and page.is_hidden('#accept')
            assert 'hand' in page.inner_text('#ticks')
            page.keyboard.press('a')
            assert page.inner_text('#said') == 'Nothing is proposed here.'
            for key in ('ArrowRight', '1', 'ArrowRight', '2'):
                page.keyboard.press(key)
            page.wait_for_function(f'Object.keys(state.marks).length === {k + 1}')
            if k < 2:
                page.keyboard.press('n')
                page.wait_for_function('!state.marks[episode]')
        page.wait_for_function('Object.keys(state.labels).length')
        page.keyboard.press('n')
        page.wait_for_function('!state.marks[episode]')
        assert page.is_visible('#accept') and page.evaluate('frame') == 3
        assert page.inner_text('#accept') == 'accept grasp 0.8 s, release 1.5 s (a)'
        assert page.inner_text('#title').endswith(
            'proposed: grasp 0.8 s (hand moves; label 1.0 s, confidence 90%), '
            'release 1.5 s (hand moves; label 1.5 s, confidence 80%)'), 'as the button has it'
        page.evaluate('go(1)')
        page.keyboard.press('1')
        assert page.inner_text('#accept') == 'accept release 1.5 s (a)', 'what is marked stays'
        page.keyboard.press('a')
        page.wait_for_function('Object.keys(state.marks).length === 4 && isSaved()')
        assert page.is_hidden('#accept')
        page.keyboard.press('a')
        assert page.evaluate('draft') == page.evaluate('state.marks[episode]') == [1, 6]
