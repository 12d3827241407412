# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is told of a loop that Meta-World judges."""

import json

from experiments.worlds import loop


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
