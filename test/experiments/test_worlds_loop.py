# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is told of a loop that Meta-World judges."""

from dataclasses import replace
import json

from experiments.worlds import loop
from experiments.worlds.pushes import GoalPushes, RandomPushes
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks


def test_marked_is_where_the_object_has_not_yet_moved_in_what_succeeds(tmp_path):
    still = [[4, 4]] * 6 + [[10, 4]] * 3
    made = []
    for i, outcome in enumerate(('success', 'failure')):
        episode = move_squares(still[:2], still[:2], seed=i, outcome=outcome)
        pixels = np.stack([still, still], axis=1).astype(np.float32)
        made.append(replace(episode, object_pixels=pixels))
    bag = write_bag(tmp_path / 'bag', made)
    (marked, ((first, last),)), = read_marks(
        loop.mark(bag), open_recordings([bag])).episodes.items()
    assert marked == 0 and first == last and abs(first - 5) <= 1


def test_scenes_without_a_goal_are_left_out_and_what_was_run_is_not_run_again(
        tmp_path, monkeypatch):
    ran = []

    def run_scene(task, method, seed, *_):
        ran.append((task, method, seed))
        return seed % 2 and {
            'task': task, 'method': method, 'seed': seed, 'ends': method != 'random',
            'ever': True, 'steps': 7, 'goal_cm': 1.0, 'start_cm': 20.0, 'final_cm': 2.5}

    monkeypatch.setattr(loop, 'run_scene', run_scene)
    (tmp_path / 'push-v3').mkdir()
    args = loop.Options(tasks=('push-v3',), scenes=2, methods=('random', 'direct'),
                        runs=str(tmp_path), out=str(tmp_path))
    weights = dict.fromkeys(('forward', 'push-v3'), '')
    loop.run_scenes(args, weights)
    assert {seed - loop.FIRST_SCENE for _, _, seed in ran} == {0, 1, 2, 3} and len(ran) == 8
    loop.run_scenes(args, weights)
    assert len(ran) == 8
    loop.write_results(tmp_path, tmp_path, args)
    rows = json.loads((tmp_path / 'worlds_loop.json').read_text())
    assert [row['seed'] - loop.FIRST_SCENE for row in rows] == [1, 1, 3, 3]
    page = (tmp_path / 'worlds_loop.md').read_text()
    assert '| push-v3 | random | 2 | 0% (0 to 66)' in page and '| direct | 2 | 100%' in page


def test_pushes_are_recorded_as_a_planner_and_its_model_need_them():
    pytest.importorskip('metaworld')
    worlds = GoalPushes('plate-slide-v3', 32), RandomPushes('push-v3', 32)
    pushed, about = (world.demonstrate(3).episode for world in worlds)
    for world in worlds:
        world.close()
    assert (pushed.task, pushed.outcome) == ('plate-slide-v3', 'success')
    for episode in (pushed, about):
        assert episode.object_source == 'ground_truth' and episode.robot_masks.any()
        moved = episode.grippers[1:, :3] - episode.grippers[:-1, :3]
        assert np.median(np.abs(moved - episode.actions[:-1, :3])) < 0.01, 'as it was told'
    way = np.linalg.norm(pushed.object_poses[:, 0] - pushed.object_poses[0, 0], axis=1)
    assert way[:4].max() < 0.01 and way[-1] > 0.1
