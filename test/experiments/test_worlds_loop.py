# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pushes recorded in Meta-World, and what is told of a loop that it judges."""

import json

from experiments.worlds import loop
from experiments.worlds.pushes import collect_pushes, push_to_goal
import numpy as np
import pytest
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.marks import read_marks


def test_pushes_of_meta_world_are_recorded_through_the_world_protocol(tmp_path):
    pytest.importorskip('metaworld')
    folder = tmp_path / 'demonstrations'
    whole = folder, 'metaworld', 'plate-slide-v3', push_to_goal, 1, 3, 32
    collect_pushes(*whole)
    store = open_recordings([folder])
    episode, file = store[0], folder / 'demonstrations_0.mcap'
    assert (episode.task, episode.outcome) == ('plate-slide-v3', 'success')
    assert episode.object_source == 'ground_truth' and episode.robot_masks.any()
    way = np.linalg.norm(episode.object_pixels[:, 0] - episode.object_pixels[0, 0], axis=1)
    assert way[:4].max() < 1 and way[-1] > 5 and np.isfinite(episode.grippers).all()
    moved = episode.grippers[1:, :3] - episode.grippers[:-1, :3]
    assert np.median(np.abs(moved - episode.actions[:-1, :3])) < 0.01, 'as it was told'
    before = file.stat().st_mtime_ns
    collect_pushes(*whole)
    assert file.stat().st_mtime_ns == before, 'what is there is kept'
    (marked, (mark,)), = read_marks(loop.mark(folder), store).episodes.items()
    assert marked == 0 and way[mark[0] - 1] < 1, 'the hand is at it, it has not yet moved'


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
