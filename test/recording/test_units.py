# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded commands are m/s where the recording tells their time, metres in older ones."""

from pathlib import Path

from made_bags import camera, command, mark, read, record, SECOND, write_mcap
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from tap_ros.base.contract import CONTROL_PERIOD
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
    assert len(warned) == sum(not 0.001 <= period <= 10 for _, period in statements)
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
