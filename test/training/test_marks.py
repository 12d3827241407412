# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of marks: their file, what is learned from them and trained with it, and their page."""

from contextlib import suppress
from dataclasses import replace
import json
import socket
import threading
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from made_episodes import make_episode, write_bag
import numpy as np
import pytest
from tap_ros.apps.cli import main
from tap_ros.apps.mark_command import Marking, MarkServer
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import only_keeper
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks, write_marks
from tap_ros.training.marks import episode_preferences, LEAST, LIKELIEST
from tap_ros.training.predictor import train
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights.weights import load_weights


@pytest.fixture
def store(bag):
    return open_recordings([bag], progress=False)


@pytest.fixture
def marks(bag, store, tmp_path):
    """Mark the middle of the first ten demonstrations."""
    path = tmp_path / 'marks.json'
    write_marks(path, store, [bag], {i: [(n // 2, n // 2)] for i, n in enumerate(
        store.lengths[:10].tolist())})
    return path


def test_marks_are_read_as_they_were_written_by_hand_too(bag, store, tmp_path):
    episodes = {0: [(2, 2), (4, 4)], 3: [(1, 5)], 20: [(3, 3)]}
    path = tmp_path / 'deep' / 'marks.json'
    write_marks(path, store, [bag], episodes)
    found = read_marks(path, store)
    assert found.episodes == episodes and len(found.digest) == 64
    first = int(store[3].stamps[0])
    for seconds in (first / 1e9 + 0.5, first / 1e9 + 0.6):  # frames are 0.25 s apart
        path.write_text(json.dumps({'marks': [
            {'recording': str(bag), 'episode': 3, 'stamps': [seconds]}]}))
        assert read_marks(path, store).episodes == {3: [(2, 2)]}
    beside = bag / 'bottlenecks.json'
    beside.write_text(json.dumps({'marks': [
        {'recording': '.', 'episode': 3, 'stamps': [[first / 1e9, first / 1e9 + 0.5]]}]}))
    assert read_marks(beside, store).episodes == {3: [(1, 2)]}
    beside.unlink()


def test_marks_of_something_else_are_refused_with_the_file_and_the_reason(bag, store, tmp_path):
    other = write_bag(tmp_path / 'other', [make_episode(1)])
    begin, end = (int(store[0].stamps[k]) / 1e9 for k in (0, -1))
    path = tmp_path / 'marks.json'

    def refusal(data):
        path.write_text(data if isinstance(data, str) else json.dumps({'marks': [
            {'recording': str(bag), 'episode': 0, 'stamps': [begin + 0.5], **data}]}))
        with pytest.raises(ConfigError) as error:
            read_marks(path, store)
        text = str(error.value)
        assert text.startswith(str(path)) and text.isprintable()
        return text

    for data, said in (
            ({'recording': str(other)}, 'none of those that are read'),
            ({'episode': 24}, 'expected 0 to 23'), ({'stamps': [begin - 1]}, 'outside'),
            ({'stamps': [end + 1]}, 'outside'), ({'stamps': [begin]}, 'start or the goal'),
            ({'stamps': [begin + 1, begin + 0.5]}, 'in order'), ({'stamps': 3}, 'list of seconds'),
            ({'stamps': [float('nan')]}, 'as seconds'), ('{', 'no file of marks')):
        assert said in refusal(data), data
    entry = {'recording': str(bag), 'episode': 0, 'stamps': [begin + 0.5]}
    assert 'marked above' in refusal(json.dumps({'marks': [entry, entry]}))


def test_a_training_learns_from_marks_and_tells_of_them(bag, store, marks, tmp_path, capsys):
    config = TrainingConfig(
        recordings=(str(bag),), out=str(tmp_path / 'run'), base_width=4, batch_size=4, steps=4,
        margin=1, start_crop=0.0, test_fraction=0.3, threads=1, save_every=2, precision='float32',
        selection='marks', marks=str(marks))
    about = load_weights(train(config, stop_at=2, progress=False), 'predictor')[2]
    told = capsys.readouterr().err
    assert 'demonstrations. Learned from the others, a mark is found within 0.2' in told
    found = about['marks']
    assert found['sha256'] == read_marks(marks, store).digest
    levels, = found['levels']
    assert levels['demonstrations'] == 10 and levels['found'] >= 4 and 0 < levels['random'] < 0.8
    assert about['settings']['marks'] == str(marks)
    train(config, progress=False)
    marks.write_text(marks.read_text().replace('"episode": 2', '"episode":  2'))
    with pytest.raises(ConfigError, match='other recordings or marks'):
        train(config, progress=False)
    for values, said in (({'recursion': 2}, 'has 1, and each needs 2'),
                         ({'held_out': (str(bag),)}, 'too short|held out')):
        with pytest.raises(Exception, match=said):
            train(replace(config, out=str(tmp_path / 'other'), **values), progress=False)
    for values in ({'marks': ''}, {'loss': 'min'}, {'selection': 'relative'},
                   {'start_crop': 0.3}, {'min_crop': 0.5}):
        with pytest.raises(ConfigError, match='^marks'):
            replace(config, **values).check()
    with pytest.raises(ConfigError, match='mark some of those that are not held out'):
        episode_preferences(store, config, np.array([23]))


def test_the_likeliest_frames_are_those_about_the_label(bag, store, marks, tmp_path):
    config = TrainingConfig(recordings=(str(bag),), selection='marks', start_crop=0.0,
                            marks=str(marks))
    everything = np.arange(len(store))
    found, about = episode_preferences(store, config, everything)
    for i, w in enumerate(found):
        assert w.shape == (1, store.lengths[i]) and w.dtype == np.float32 and w.max() == 1
        assert (w > LEAST).sum() <= LIKELIEST and np.isfinite(np.log(w)).all()
        if i < 10:
            assert w[0].argmax() == store.lengths[i] // 2, 'what was marked is not guessed'
    assert np.mean([abs(w[0].argmax() - n // 2) <= 1
                    for w, n in zip(found[10:], store.lengths[10:])]) > 0.7
    # Of two marks the later one comes first between start and goal, the earlier one forward.
    write_marks(marks, store, [bag], {i: [(1, 1), (3, 3)] for i in range(10)})
    two = replace(config, recursion=2)
    back, ahead = (episode_preferences(store, one, everything)[0] for one in (
        two, replace(two, mode='forward')))
    for one, other in zip(back, ahead):
        np.testing.assert_array_equal(one, other[::-1])
    assert back[0].argmax(1).tolist() == [3, 1]


@pytest.fixture
def page(bag, store, tmp_path):
    """Serve the page; return what asks it, and the file it writes."""
    path = tmp_path / 'marks.json'
    server = MarkServer(Marking(store, [str(bag)], path))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()

    def ask(place, data=None, **headers):
        return urlopen(Request(f'http://127.0.0.1:{server.port}/{place}', data, headers))

    yield ask, path
    server.shutdown()
    thread.join()
    server.server_close()


def test_the_page_shows_frames_and_writes_marks_at_once(page, bag, store):
    ask, path = page
    assert b'mark.js' in ask('').read() and b'ArrowLeft' in ask('mark.js').read()
    assert ask('frame/3/2').read().startswith(b'\x89PNG')
    state = json.load(ask('state'))
    assert state['lengths'] == store.lengths.tolist() and state['next'] == 0
    visited = []
    for _ in range(24):
        i = state['next']
        visited.append(i)
        state = json.load(ask('mark', json.dumps({'episode': i, 'frames': [4, 2]}).encode()))
        assert read_marks(path, store).episodes[i] == [(2, 2), (4, 4)]
        assert state['marks'][str(i)] == [2, 4]
    assert sorted(visited) == list(range(24)) and state['next'] is None
    assert visited[1] == 23 and 8 < visited[2] < 15  # far from those before
    path.write_text(path.read_text().replace('{"marks"', '{"names": ["a", "b"], "marks"'))
    Marking(store, [str(bag)], path).mark(4, [2, 5])
    assert read_marks(path, store).names == ('a', 'b')  # of who wrote them by hand
    state = json.load(ask('mark', b'{"episode": 5, "frames": []}'))
    assert state['next'] == 5 and 5 not in read_marks(path, store).episodes
    assert json.loads(json.dumps(Marking(store, [str(bag)], path).state())) == state
    before = path.read_bytes()
    for place, data, headers, code in (
            ('mark', b'{"episode": 1, "frames": [0]}', {}, 400), ('mark', b'x', {}, 400),
            ('mark', b'{"episode": 1, "frames": ""}', {}, 400), ('mark', b'[' * 60000, {}, 400),
            ('mark', b' ' * 70000, {}, 413), ('mark', b'', {'Content-Length': '-1'}, 413),
            (f'frame/{"9" * 5000}/0', None, {}, 404),
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
    assert json.load(ask('state')) == state


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
