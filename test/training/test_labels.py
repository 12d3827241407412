# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of labels: moments are found, in their order and at any rate."""

import csv
from dataclasses import replace
import json
import shutil

from made_episodes import make_episode, write_bag
from mcap.reader import make_reader
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.apps.label_command import distinct_names
from tap_ros.base.errors import ConfigError
from tap_ros.messages.stamps import to_nanoseconds
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks, write_marks
from tap_ros.recording.messages import decode
from tap_ros.training.labels import film, label, MomentModel, moments_of

COUNT, MARKED = 16, 8


def two_moves(seed, rate=10):
    """Draw one square that moves, then another; return frames, stamps in ns, ends (2,) s."""
    rng = np.random.default_rng(seed)
    rest, first, pause, second, end = rng.uniform((.8, 1, .8, 1, .8), (2, 2, 2, 2, 2))
    times = np.arange(0, rest + first + pause + second + end, 1 / rate)
    done = np.stack([np.clip((times - rest) / first, 0, 1),
                     np.clip((times - rest - first - pause) / second, 0, 1)], 1)
    at = np.array([[6., 8], [8, 22]]) + done[..., None] * np.array([18., 0])  # T, K, (u, v)
    frames = np.full((len(times), 32, 40, 3), 40, np.uint8)
    frames += rng.integers(0, 6, frames.shape, dtype=np.uint8)
    for t, k in np.ndindex(len(times), 2):
        u, v = np.rint(at[t, k]).astype(int)
        frames[t, v - 2:v + 3, u - 2:u + 3] = (200, 60 + 90 * k, 20)
    return frames, np.rint(times * 1e9).astype(np.int64), np.array(
        [rest + first, rest + first + pause + second])


@pytest.fixture(scope='module')
def shown():
    return [two_moves(seed) for seed in range(COUNT)]


@pytest.fixture(scope='module')
def films(shown):
    return [film(frames, stamps) for frames, stamps, _ in shown]


def found(films, shown, names=('first', 'second')):
    return label(films, {i: shown[i][2][:len(names)] for i in range(MARKED)}, names)


def test_each_moment_is_found_where_it_was_not_marked(films, shown):
    labels = found(films, shown)
    off = np.abs(np.stack(labels.moments) - np.stack([one[2] for one in shown]))
    assert (off[MARKED:] <= 0.3).mean() > 0.9
    assert all((labels.moments[i] == shown[i][2]).all() for i in range(MARKED))
    assert all((one > 0.5).all() and (one <= 1).all() for one in labels.confidence)
    assert (labels.confidence[0] == 1).all() and (labels.confidence[-1] < 1).all()
    true = np.stack([one[2] for one in shown])
    assert np.median(np.abs(np.stack(labels.left_out) - true[:MARKED])) <= 0.3
    model = MomentModel(films[:MARKED], [one[2] for one in shown[:MARKED]], 0.1)
    for one in films:
        posterior = np.exp(model.log_posterior(one))
        assert posterior.shape == (2, len(one)) and np.allclose(posterior.sum(1), 1)
        assert (posterior[:, [0, -1]] == 0).all()


def test_marks_come_in_their_order(films, shown):
    model = MomentModel(films[:MARKED], [one[2] for one in shown[:MARKED]], 0.1)
    for one in films[MARKED:]:
        first, second = moments_of(one, model.log_posterior(one))[0]
        assert 0 < first < second
    with pytest.raises(ConfigError, match='as many|the same marks'):
        MomentModel(films[:2], [shown[0][2], shown[1][2][:1]], 0.1)
    with pytest.raises(ConfigError, match='expected 1 in each demonstration, a, got'):
        label(films, {0: shown[0][2]}, ['a'])


def test_a_label_does_not_depend_on_the_rate_of_the_camera(shown, films):
    labels = found(films, shown)
    for rate in (5, 30):
        again = [two_moves(seed, rate) for seed in range(COUNT)]
        other = found([film(frames, stamps) for frames, stamps, _ in again], again)
        gap = np.abs(np.stack(other.moments) - np.stack(labels.moments))[MARKED:]
        assert np.median(gap) <= 0.2 and (gap <= 0.5).mean() > 0.9


def test_the_command_labels_every_demonstration(tmp_path, shown, capsys):
    bag = write_bag(tmp_path / 'squares', [replace(make_episode(
        i, len(stamps), size=frames.shape[1:3]), frames=frames, stamps=stamps + (i + 1) * 10 ** 11,
        goal_frame=frames[-1]) for i, (frames, stamps, _) in enumerate(shown)])
    store = open_recordings([bag], progress=False)
    marks = tmp_path / 'squares.marks.json'
    write_marks(marks, store, [bag], {i: [
        (int(t), int(t)) for t in np.rint(10 * shown[i][2])] for i in range(MARKED)})
    marks.write_text(marks.read_text().replace('{"marks"', '{"names": ["a", "b"], "marks"'))
    assert main(['label', str(bag), '--out', str(tmp_path / 'out')]) == 0
    assert 'a, label: ' in (printed := capsys.readouterr().out) and 'random frame' in printed
    content = json.loads((tmp_path / 'out' / 'labels.json').read_text())
    rows = list(csv.DictReader((tmp_path / 'out' / 'labels.csv').open()))
    assert content['names'] == ['a', 'b'] and len(rows) == len(content['labels']) == 2 * COUNT
    assert [row['name'] for row in rows[:2]] == ['a', 'b']
    last = content['labels'][-1]
    assert last['seconds'] == pytest.approx(shown[-1][2][1], abs=0.5)
    assert last['stamp'] == pytest.approx(100 * COUNT + last['seconds'], abs=0.01)
    found = read_marks(tmp_path / 'out' / 'labels.marks.json', store)
    assert found.names == ('a', 'b') and len(found.episodes) == COUNT
    assert found.labels == {*range(MARKED, COUNT)}
    again = tmp_path / 'out' / 'labels.marks.json'
    assert main(['label', str(bag), '--marks', str(again), '--out', str(tmp_path / 'more')]) == 0
    assert f'Each of {MARKED} marked demonstrations' in capsys.readouterr().out
    for i, those in found.episodes.items():
        seconds = [row['seconds'] for row in content['labels'][2 * i:2 * i + 2]]
        assert np.allclose([first / 10 for first, _ in those], seconds, atol=0.051)
    assert (tmp_path / 'out' / 'labels.png').read_bytes()[:4] == b'\x89PNG'
    check_events(tmp_path / 'out' / 'squares.labels.mcap', content['labels'], store)


def check_events(path, rows, store):
    """Hold the messages of a file of events against the labels, and the times of the recording."""
    moments, subtasks = {}, []
    with open(path, 'rb') as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            content = decode(schema.name, message.data)
            if channel.topic == '/labels':
                assert schema.name == 'rcl_interfaces/msg/Log'
                moments[message.log_time] = content
            else:
                assert (channel.topic, schema.name) == ('/labels/subtask', 'std_msgs/msg/String')
                subtasks.append((message.log_time, content.data))
    assert subtasks == sorted(subtasks, key=lambda one: one[0])
    assert [text for _, text in subtasks] == ['before a', 'a to b', 'after b', ''] * COUNT
    assert [time for time, text in subtasks if text in ('before a', '')] == [
        time for i in range(COUNT) for time in store.seen(i)]
    assert len(moments) == len(rows)
    for (log, one), row in zip(moments.items(), rows):
        assert one.name == row['name'] and to_nanoseconds(one.stamp) == log
        assert log / 1e9 == pytest.approx(row['stamp'], abs=1e-5)
        assert one.level == (30 if row['confidence'] < 0.5 else 20)
        assert f'{row["seconds"]:.1f} s' in one.msg


def test_events_of_bags_with_one_name_are_kept_apart(tmp_path):
    bags = [write_bag(tmp_path / part / 'bag', [make_episode(k)]) for k, part in enumerate('ab')]
    loose = tmp_path / 'b' / 'alone.mcap'
    shutil.copy(bags[1] / 'bag_0.mcap', loose)
    store = open_recordings([*bags, loose], progress=False)
    assert list(distinct_names(store).values()) == ['bag', 'bag-2', 'alone']
