# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of foreign demonstrations, and how often they are the true bottleneck."""

import json

from experiments.worlds import command, keyframes
from experiments.worlds.ogbench import OGBench
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from sim_bridge.collect import BOTTLENECKS_FILE, collect, CollectConfig
from tap_ros.base.engines import Engine
from tap_ros.base.errors import ConfigError
from tap_ros.recording.cache import open_recordings


def film(places, size=28):
    """Draw a bright square at places (T,) px along a row; uint8 (T, size, size, 3)."""
    frames = np.zeros((len(places), size, size, 3), np.uint8)
    for frame, place in zip(frames, places):
        frame[4:16, int(place):int(place) + 12] = 255
    return frames


REST = film([0, 0, 0, 2, 4, 5, 6, 6, 6, 6, 6, 8, 10, 11, 12, 12])  # from frame 6 to 10


def test_the_slowest_frame_is_where_things_rest_on_the_way_and_not_at_the_ends():
    assert 6 < keyframes.slowest(REST) < 10 and keyframes.middle(REST) == 7


def test_the_last_subgoal_is_where_the_way_turns_to_the_goal():
    there_and_on = film([6, 5, 4, 3, 2, 1, 0, 3, 6, 9, 12, 12])
    assert abs(keyframes.uvd(there_and_on) - 6) <= 1
    assert keyframes.uvd(film(range(12))) == 0  # none


def test_scores_are_shares_of_the_demonstrations_with_their_intervals():
    shown = 40 * [command.Demonstration(REST, (7, 8), np.arange(len(REST)) / 10)]
    rows = {row['method']: row for row in command.score([(shown[:12], 12 * [7])], shown)}
    assert rows['random']['hit']['value'] == pytest.approx(2 / 14)
    assert rows['slowest']['hit']['value'] == rows['10 marks']['near']['value'] == 1
    assert rows['UVD-like']['hit'] | {'low': 0} == {'value': 0, 'low': 0, 'high': pytest.approx(
        0.0876, abs=1e-3)} and rows['slowest']['n'] == 40


def test_bottlenecks_are_read_by_their_stamps(tmp_path):
    with pytest.raises(ConfigError, match='bottlenecks.json: is not there'):
        command.read(tmp_path)
    write_bag(tmp_path / 'bag', [move_squares([[3, 3]], [[8, 8]], length=7, seed=seed)
                                 for seed in range(2)])
    stamps = [list(episode.stamps / 1e9) for episode in open_recordings(tmp_path / 'bag')]
    (tmp_path / 'bag' / 'bottlenecks.json').write_text(json.dumps(
        {'marks': [{'recording': '.', 'episode': 1, 'stamps': [[stamps[1][2], stamps[1][4]]]}]}))
    found, = command.read(tmp_path / 'bag')
    assert len(found.frames) == 7 and (found.window, found.number) == ((2, 4), 1)
    assert found.frames.shape[1:] == (64, 64, 3)


def test_predictors_with_keyframes_are_compared_over_tasks_of_several_trainings():
    def row(task, method, value, seeds=3):
        share = {'value': value, 'low': value - 0.1, 'high': min(value + 0.1, 1.0)}
        return {'task': task, 'method': method, 'seeds': seeds, 'hit': share, 'near': share,
                'error': {'value': 1 - value}}

    rows = [row('aside/a/one', 'marks', 0.5), row('aside/a/one', 'keyframes', 0.7),
            row('a/two', 'marks', 0.9), row('a/two', 'keyframes', 0.8),
            row('a/alone', 'marks', 0.1, 1), row('a/alone', 'keyframes', 0.9, 1)]
    found = command.compare(rows)
    assert found['tasks'] == 2 and found['hit'] == found['near'] == '+5 (-10 to +20)'
    assert found['error'] == '1.30 (0.60 to 2.00)'
    assert found['alone'] == dict.fromkeys(('hit', 'near'), ['one +20 (+6 to +34)'])
    assert command.compare(rows[::2]) == {}


def test_one_method_alone_leaves_what_others_have_scored(tmp_path):
    file, old = tmp_path / 'rows.json', [
        {'task': 'a', 'method': method, 'hit': 1} for method in ('marks', 'keyframes')]
    assert command.merged(file, old[:1]) == old[:1]
    file.write_text(json.dumps(old))
    new = [{'task': 'a', 'method': 'marks', 'hit': 2}, {'task': 'b', 'method': 'marks', 'hit': 3}]
    assert command.merged(file, new) == [new[0], old[1], new[1]]


def test_some_tasks_alone_have_a_page():
    share = {'value': 0.5, 'low': 0.4, 'high': 0.6}
    page = command.page([
        {'task': 'ogbench/cube', 'method': method, 'hit': share, 'near': share, 'n': 40,
         'frames': 37.0, 'bottleneck_frames': 4.0} for method in ('random', 'middle', 'slowest')])
    assert '| ogbench cube | 50%, 50% |' in page and 'Kept aside' not in page
    assert '37 to 37 frames on average, bottlenecks 4.0 to 4.0' in page


@pytest.mark.parametrize('task', ['drawer', 'cube-double', 'puzzle'])
def test_oracles_of_ogbench_demonstrate_as_unsteadily_as_people_do(task, tmp_path):
    pytest.importorskip('ogbench')
    config = CollectConfig(world='ogbench', task=task, episodes=1, seed=2, image_size=32)
    collect(tmp_path, config, Engine(workers=1), progress=False, make=OGBench)
    episode, = open_recordings(tmp_path)
    assert (episode.task, episode.outcome) == (task, 'success')
    world = OGBench(task, 32)
    again = world.demonstrate(2)
    world.close()
    np.testing.assert_array_equal(episode.frames, again.episode.frames)
    mark, = json.loads((tmp_path / BOTTLENECKS_FILE).read_text())['marks']
    assert mark['stamps'] == [[episode.stamps[t] / 1e9 for t in again.bottleneck]]
