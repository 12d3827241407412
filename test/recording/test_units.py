# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded commands are m/s where the recording tells their time, metres in older ones."""

from pathlib import Path

from made_bags import (
    camera,
    command,
    mark,
    read,
    record,
    record_files,
    SECOND,
    write_mcap,
)
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from tap_ros.base.contract import CONTROL_PERIOD
from tap_ros.recording import file_writer
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.messages import encode
from tap_ros.recording.writer import EpisodeWriter

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'  # in metres
FLOAT = 'std_msgs/msg/Float64'


def told(t, period, topic='/arm/control_period'):
    return topic, FLOAT, encode(FLOAT, {'data': period}), round(t * SECOND)


@pytest.mark.parametrize('statements, seconds', [
    ([], [1, 1, 1]), ([(0.5, 0.25)], [0.25] * 3), ([(0.5, 0.5)], [0.5] * 3),
    ([(2.6, 0.1)], [0.1] * 3),  # a planner that starts when the arm was moved by hand before
    ([(0.5, 0.25), (2.6, 0.5)], [0.25, 0.25, 0.5]),
    ([(0.5, 0.25), (0.6, 0.1)], [0.1] * 3),  # the recorder's, then the arm's own
    ([(0.5, 0.25), (3.6, 0.1)], [0.25] * 3),
    ([(0.5, float('nan'))], [CONTROL_PERIOD] * 3), ([(0.5, 0.5), (2.5, 250.0)], [0.5] * 3),
    ([(0.5, 0.5), (2.5, 1e-300)], [0.5] * 3), ([(0.5, -1.0), (2.5, 0.5)], [0.5] * 3)])
def test_commands_are_multiplied_by_the_time_that_is_told(tmp_path, statements, seconds):
    messages = [mark(1, 0), *(camera(t) for t in (1, 2, 3, 4)), *(
        command(t, 0.1 * t, log=t + 0.1) for t in (1, 2, 3)), mark(4, 1, 'success'),
        *(told(*one) for one in statements)]
    bag = record(tmp_path / 'bag', sorted(messages, key=lambda one: one[3]))
    (episode,), warned = read(bag)
    np.testing.assert_allclose(
        episode.actions[:, 0], [*np.multiply(seconds, [0.1, 0.2, 0.3]), 0], rtol=1e-6)
    good = [period for _, period in statements if 0.001 <= period <= 10]
    doubts = len({*seconds}) > 1 or (bool(statements) and not good)
    assert len(warned) == len(statements) - len(good) + doubts
    assert all('/arm/control_period' in line for line in warned)


@pytest.mark.parametrize('periods, expected', [
    ([], 1.0),  # an older recording
    ([('/arm/control_period', None)], CONTROL_PERIOD),  # the file of a bag behind its first one
    ([('/arm/control_period', 0.25), ('/left/arm/control_period', 0.5)], 0.5),
    ([('/arm/control_period', 0.25), ('/left/arm/control_period', None)], 0.25),
    ([('/a/arm/control_period', 0.25), ('/b/arm/control_period', 0.5)], 0.5)])
def test_the_time_is_that_of_the_commands_and_never_overlooked(tmp_path, periods, expected):
    messages = [mark(1, 0), *(told(0.5 + k / 10, period, topic) for k, (topic, period) in
                              enumerate(periods) if period), *(camera(t) for t in (1, 2)), *(
        (f'/left{topic}', *rest) for topic, *rest in [command(1, 0.1, log=1.1)]),
        mark(2, 1, 'success')]
    path = write_mcap(tmp_path / 'a.mcap', sorted(messages, key=lambda one: one[3]),
                      [(topic, FLOAT) for topic, _ in periods])
    (episode,), _ = read(path)
    np.testing.assert_allclose(episode.actions[0, 0], 0.1 * expected, rtol=1e-6)


def test_a_period_told_once_holds_in_later_files_also_where_the_clock_was_set_back(tmp_path):
    def part(begin, *others):
        times = begin + np.arange(1, 4)
        return sorted([mark(begin + 0.9, 0), *map(camera, times), *(
            command(t, 0.1, log=t + 0.1) for t in times[:-1]), mark(begin + 3.2, 1, 'success'),
            *others], key=lambda one: one[3])

    bag = record_files(tmp_path / 'bag', part(100, told(100.5, 0.5)), part(50), part(
        10, told(12.05, 1.0)))
    episodes, warned = read(bag)
    np.testing.assert_allclose([one.actions[:-1, 0] for one in episodes],
                               [[0.05, 0.05], [0.05, 0.05], [0.05, 0.1]], rtol=1e-6)
    assert ['changes once, first from 0.5 to 1 s' in line for line in warned] == [True]


def test_a_second_planner_that_tells_another_period_is_named(tmp_path):
    messages = [mark(1, 0), *map(camera, (1, 2, 3)), command(1, 0.1, log=1.1), command(
        2, 0.1, log=2.6), mark(3, 1, 'success'), *(told(0.5 + t / 2, (0.25, 0.5)[t % 2])
                                                   for t in range(5))]
    _, (warned,) = read(record(tmp_path / 'bag', sorted(messages, key=lambda one: one[3])))
    assert 'once, first from 0.5 to 0.25 s' in warned and 'second planner' in warned


@pytest.mark.parametrize('summary', [True, False])
def test_a_first_chunk_that_is_lost_is_told_of_where_it_may_have_held_the_period(
        tmp_path, monkeypatch, summary):
    monkeypatch.setattr(file_writer, 'CHUNK_BYTES', 1)
    later = [mark(1, 0), *map(camera, (1, 2, 3)), command(1, 0.1, log=1.1), mark(3, 1, 'success')]
    path, = record(tmp_path / 'bag', [told(0.5, 0.5), *sorted(
        later, key=lambda one: one[3])]).glob('*.mcap')
    data = bytearray(path.read_bytes())
    with open(path, 'rb') as stream:
        first = next(one for one in StreamReader(stream, emit_chunks=True).records
                     if isinstance(one, Chunk))
    at = data.index(first.data)
    data[at:at + len(first.data)] = bytes(len(first.data))
    path.write_bytes(data if summary else data[:data.rindex(b'\x0f')])
    (episode,), warned = read(path)
    doubts = [line for line in warned if 'commands count as' in line]
    assert len(doubts) == 1 and '/arm/control_period' in doubts[0]
    assert f'{episode.actions[0, 0]:.3f}' == ('0.025' if summary else '0.100')


def test_an_older_recording_written_anew_gives_the_same_actions(tmp_path):
    before = list(open_recordings(SAMPLE, progress=False))[:3]
    with EpisodeWriter(tmp_path / 'a.mcap') as writer:
        for episode in before:
            writer.write(episode)
    after = list(open_recordings(tmp_path / 'a.mcap', progress=False))
    units = [open_recordings(path, progress=False).commands for path in (
        SAMPLE, tmp_path / 'a.mcap')]
    assert units == [['m in a control period'], ['m/s']]
    assert all(np.array_equal(one.actions, other.actions)
               for one, other in zip(before, after, strict=True))
    fastest = {}
    for path in (SAMPLE, tmp_path / 'a.mcap'):
        with AnyReader([path]) as reader:
            twists = [reader.deserialize(data, one.msgtype).twist.linear for one, _, data in
                      reader.messages([one for one in reader.connections if one.topic.endswith(
                          'delta_twist_cmds')])]
        fastest[path] = max(abs(one.x) for one in twists[:sum(map(len, before)) - 3])
    assert fastest[tmp_path / 'a.mcap'] == fastest[SAMPLE] / CONTROL_PERIOD
