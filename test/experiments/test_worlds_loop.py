# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is told of a loop that Meta-World judges."""

from dataclasses import replace
import json

from experiments.worlds import judged, loop
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks


def write_moves(tmp_path, places, outcomes, metres=None):
    """Write a bag of one object, at places in pixels and in metres."""
    made = []
    for i, outcome in enumerate(outcomes):
        episode = move_squares(places[:2], places[:2], seed=i, outcome=outcome)
        poses = np.zeros((len(places), 1, 7))
        if metres is not None:
            poses[:, 0, :2] = metres
        made.append(replace(
            episode, object_names=episode.object_names[:1], object_poses=poses,
            object_pixels=np.array(places, np.float32)[:, None],
            goal_pixels=episode.goal_pixels[:1], goal_poses=episode.goal_poses[:1]))
    return write_bag(tmp_path / 'bag', made)


def test_marked_is_where_the_object_has_not_yet_moved_in_what_succeeds(tmp_path):
    bag = write_moves(tmp_path, [[4, 4]] * 6 + [[10, 4]] * 3, ('success', 'failure'))
    (marked, ((first, last),)), = read_marks(
        loop.mark(bag), open_recordings([bag])).episodes.items()
    assert marked == 0 and first == last and abs(first - 5) <= 1


def test_marked_is_where_the_object_comes_to_rest_by_the_way(tmp_path):
    metres = [[0, 0], [0.05, 0], *[[0.12, 0]] * 3, [0.12, -0.1], *[[0.12, -0.2]] * 3]
    bag = write_moves(tmp_path, [[4, 4]] * 9, ('success',), metres)
    (marks,) = read_marks(loop.mark(bag, ((0.13, 0), (0.12, -0.21))),
                          open_recordings([bag])).episodes.values()
    assert [first for first, _ in marks] in ([a, b] for a in (2, 3) for b in (6, 7))


def test_marked_is_where_the_first_object_rests_at_its_goal_and_the_other_has_not_come(tmp_path):
    episode = move_squares([[4, 4]] * 2, [[4, 4]] * 2, outcome='success')
    poses, goals = np.zeros((12, 2, 7)), np.zeros((2, 7))
    goals[:, 0] = -0.2, 0.2
    poses[:, 1, 0] = [0, 0, 0.1, 0.19, *[0.2] * 8]  # goes first
    poses[:, 0, 0] = [*[0] * 7, -0.1, -0.19, *[-0.2] * 3]
    bag = write_bag(tmp_path / 'bag', [replace(
        episode, frames=np.repeat(episode.frames[:1], 12, 0), stamps=np.arange(12) * 10 ** 8,
        actions=np.zeros((12, 4), np.float32), grippers=np.zeros((12, 4), np.float32),
        object_pixels=np.zeros((12, 2, 2), np.float32), object_poses=poses, goal_poses=goals)])
    (((first, last),),) = read_marks(loop.mark(bag), open_recordings([bag])).episodes.values()
    assert first == last and first in (3, 4)


def test_a_fixed_time_is_marked_at_equal_shares_of_every_demonstration(tmp_path):
    bag = write_moves(tmp_path, [[4, 4]] * 9, ('success', 'failure'))
    marks = read_marks(loop.mark_times(bag, 2), open_recordings([bag])).episodes
    assert {i: list(map(tuple, those)) for i, those in marks.items()} == dict.fromkeys(
        (0, 1), [(3, 3), (6, 6)])


def test_points_ahead_are_told_of_scenes_that_both_ran():
    rows = [{'task': 'push-wall-v3', 'seed': seed, 'method': method, 'ends': ends}
            for seed in range(4) for method, ends in (
                ('direct', False), ('random', True), ('subgoal', seed > 0), ('subgoal', seed > 1))]
    alone = [{**rows[0], 'seed': seed, 'ends': True} for seed in range(5, 9)]
    assert loop.ahead(rows + alone) == {'direct': '+62 points (+25 to +100)'}
    assert loop.ahead(rows[:2]) == loop.ahead([]) == {}


def test_runs_in_which_no_command_goes_to_a_subgoal_are_told_apart():
    rows = [{'method': 'subgoal', 'ends': ends, 'switches': switches} for ends, switches in (
        (True, [0, 9]), (False, [8, 8]), (False, [8, 9]), (True, [18, 36]), (True, []))]
    assert loop.dropped([*rows, {**rows[1], 'method': 'fixed time'}, {'method': 'random'}],
                        'subgoal') == '2 of 5 (1 succeed, of the others 2 of 3)'


def test_failures_after_all_subgoals_are_told_apart():
    rows = [{'task': 'push-wall-v3', 'method': method, 'ends': ends, 'switches': switches}
            for method, ends, switches in (
                ('subgoal', False, [3, 9]), ('subgoal', False, [3]), ('subgoal', True, [2, 5]),
                ('direct', False, []))]
    assert loop.last_legs(rows) == '1 of 2 failures'
    assert loop.last_legs(rows[2:]) == ''


def test_scenes_without_a_goal_are_left_out_and_what_was_run_is_not_run_again(
        tmp_path, monkeypatch):
    ran = []

    def run_scene(task, method, seed, *_):
        ran.append((task, method, seed))
        return seed % 2 and {
            'task': task, 'method': method, 'seed': seed, 'ends': method != 'random',
            'ever': True, 'steps': 7, 'goal_cm': 1.0, 'start_cm': 20.0, 'final_cm': 2.5,
            'switches': []} or None

    monkeypatch.setattr(loop, 'run_scene', run_scene)
    monkeypatch.setattr(loop, 'make_weights', lambda args, task, seed: {
        'subgoal': judged.Weights(predictor=str(seed))})
    args = loop.Options(
        tasks=('push-v3',), scenes=2, methods=('random', 'straight', 'around', 'subgoal'),
        seeds=2, runs=str(tmp_path), out=str(tmp_path))
    loop.run(args)
    assert {seed - loop.FIRST_SCENE for _, _, seed in ran} == {0, 1, 2, 3}
    # Nothing is in the way of push-v3; a scene without a goal is tried once; two trainings.
    assert len(ran) == 2 + 2 * 2 + 2 * 2
    loop.run(args)
    assert len(ran) == 10
    rows = json.loads((tmp_path / 'worlds_loop.json').read_text())
    assert [row['seed'] - loop.FIRST_SCENE for row in rows] == [1] * 4 + [3] * 4
    assert [row['training'] for row in rows] == [0, 0, 0, 1] * 2
    page = (tmp_path / 'worlds_loop.md').read_text()
    assert '| push-v3 | random | 2 |' in page and '0% (0 to 66)' in page
    assert '| push-v3 | subgoal | 2 | 2 | 100%' in page
    assert '**Trainings differ**: subgoal 100%, 100%.' in page
    with pytest.raises(ConfigError, match='dircet unknown'):
        loop.run(replace(args, methods=('dircet',)))


def test_places_that_are_put_by_hand_are_subgoals_there():
    pytest.importorskip('metaworld')
    world = judged.Judged('push-wall-v3', 64)
    start = world.reset(loop.FIRST_SCENE)
    first, second = judged.Places(world).predict(
        start.image, world.goal().image, start.object_pixels, world.goal().object_pixels,
        recursion_depth=2)
    np.testing.assert_allclose(
        first.expected_pixels, world.camera.project([[0.12, 0, 0.02]]), atol=0.01)
    assert second.expected_pixels[0, 1] > first.expected_pixels[0, 1] + 10, 'nearer to the camera'
    world.close()


def test_half_way_in_ogbench_the_first_cube_is_at_its_goal_and_the_other_at_its_start():
    pytest.importorskip('ogbench')
    world = judged.Judged('ogbench/cube-double', 64)
    start = world.reset(loop.FIRST_SCENE)
    subgoal, = judged.Places(world).predict(
        start.image, world.goal().image, start.object_pixels, world.goal().object_pixels)
    first, last = world.order
    expected = start.object_pixels.copy()
    expected[first] = world.goal().object_pixels[first]
    np.testing.assert_allclose(subgoal.expected_pixels, expected, atol=0.1)
    world.close()
