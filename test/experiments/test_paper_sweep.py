# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the sweep, with tiny recordings and a few steps of training."""

from dataclasses import replace
from functools import partial
import json
from pathlib import Path

from experiments.paper import command
from experiments.paper import sweep as sweep_module
from experiments.paper.job import DONE, perform
from experiments.paper.places import (
    Places,
    recording_hash,
)
from experiments.paper.recordings import held_out_share, SHIFTED
from experiments.paper.runs import paper_runs, PaperRun, SCALES
from experiments.paper.sweep import find_state, sweep
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.options import parse
from tap_ros.recording.cache import open_recordings
from tap_ros.training.split import split_episodes

SEEDS = (122, 142, *range(4), 6, 8)  # the first two are held out
EPISODES = len(SEEDS)
RUN = PaperRun('push2', 'bidirectional', 'genmin-wo-gan', new_pixels=False, episodes=EPISODES,
               steps=2)


def write_squares(folder, seeds, size=16):
    """Write episodes of two squares that move one after the other."""
    start = [np.random.default_rng(seed).uniform(3, 7, (2, 2)) for seed in seeds]
    write_bag(folder, [
        move_squares(at, at + 5, length=7, size=size, half=1, seed=seed, task=folder.name)
        for at, seed in zip(start, seeds)])


@pytest.fixture
def small(monkeypatch):
    """Train small networks, in this process: pools of processes have tests of their own."""
    def run_here(tasks, *_):
        for task in tasks:
            yield task, partial(task.function, *task.args)
    monkeypatch.setattr(sweep_module, 'run_tasks', run_here)
    monkeypatch.setitem(SCALES, 'small', replace(SCALES['small'], settings={
        'base_width': 4, 'batch_size': 4, 'threads': 1}))


@pytest.fixture
def places(tmp_path):
    for name in ('push2', *SHIFTED):
        write_squares(tmp_path / 'bags' / name, SEEDS)
    return Places(*(str(tmp_path / name) for name in ('bags', 'runs', 'results')))


def test_a_run_leaves_a_number_for_every_held_out_episode(places, small):
    assert find_state(RUN, places).kind == 'missing'
    assert perform(RUN, places) == DONE
    state = find_state(RUN, places, {'push2': recording_hash(places.recording('push2'))})
    assert state.kind == 'done'
    result = json.loads(places.result(RUN).read_text())
    assert result == state.result
    store = open_recordings([str(places.recording('push2'))])
    held_out = len(split_episodes(store, held_out_share(EPISODES))[1])
    assert held_out == 2
    assert result['data']['hash'] == store.data_hash
    scores = result['evaluation']
    for method in ('prediction', 'copy-start', 'copy-goal'):
        assert {name: len(values) for name, values in scores[method].items()} == dict.fromkeys(
            ('min_l1', 'match_step', 'match_fraction', 'changed_l1', 'bottleneck',
             'object_mass', 'hand', 'objects', 'copying'), held_out)
    for name, count in {'arm_elsewhere': held_out, **dict.fromkeys(SHIFTED, EPISODES)}.items():
        for method in ('prediction', 'copy-goal'):
            assert len(scores['shifted'][name][method]['min_l1']) == count
    assert len(scores['bottleneck_at']) == held_out


def test_samples_and_forward_prediction_are_scored(places, small):
    vae = replace(RUN, method='genmin-vae', new_pixels=True)
    forward = replace(RUN, mode='forward', method='genmin2')
    assert perform(vae, places) == perform(forward, places) == DONE
    scores = find_state(vae, places).result['evaluation']
    best, single = scores['best_of_100']['min_l1'], scores['prediction']['min_l1']
    assert all(a <= b for a, b in zip(best, single))
    scores = find_state(forward, places).result['evaluation']
    assert 'copy-start' in scores and 'copy-goal' not in scores
    painting = replace(RUN, new_pixels=True)
    assert perform(painting, places) == DONE
    scores = find_state(painting, places).result['evaluation']
    first, second = scores['recursion']
    assert first['min_l1'] == scores['prediction']['min_l1'] != second['min_l1']


def test_other_settings_or_recordings_are_not_done(places, tmp_path, small):
    perform(RUN, places)
    path, data_hash = places.result(RUN), recording_hash(places.recording('push2'))
    assert find_state(replace(RUN, steps=3), places).kind == 'other'
    assert find_state(RUN, places, {'push2': 'of other recordings'}).kind == 'other'
    assert find_state(RUN, places, {SHIFTED[0]: 'of other recordings'}).kind != 'done'
    # Elsewhere, without the weights or the recordings, the result alone says that it is done.
    elsewhere = replace(places, runs=str(tmp_path / 'none'), recordings=str(tmp_path / 'none'))
    assert find_state(RUN, elsewhere).kind == 'done'
    path.unlink()
    state = find_state(RUN, places, {'push2': data_hash})
    assert (state.kind, state.steps) == ('partial', 2)
    path.write_text('{"torn": ')
    assert find_state(RUN, places, {'push2': data_hash}).kind == 'partial'


def test_one_failed_run_does_not_stop_the_others(places, small):
    write_squares(Path(places.recordings) / 'grasp', [0])  # one episode: none can be held out
    bad = replace(RUN, task='grasp')
    calls = []
    ends = sweep([bad, RUN], places, on_done=lambda: calls.append(1), progress=False)
    assert {end.name: end.kind for end in ends} == {bad.name: 'failed', RUN.name: 'done'}
    assert len(calls) == 1
    failed = next(end for end in ends if end.kind == 'failed')
    assert failed.reason.startswith('error: ') and 'grasp' in failed.reason
    assert sweep([RUN], places, progress=False) == []


def arguments(places, *options):
    return parse(command.Options, [
        '--recordings', places.recordings, '--runs', places.runs, '--results', places.results,
        '--episodes', str(EPISODES), '--steps', '2', *options])


def test_the_command_lists_and_does_what_fits_the_pattern(places, small, capsys, monkeypatch):
    pages = []
    monkeypatch.setattr(command, '_write_results', lambda places, pictures: pages.append(pictures))
    run = paper_runs('small', episodes=EPISODES, steps=2)[0]
    options = ('--only', run.name)
    assert command.run(arguments(places, *options, '--list')) == 0
    assert 'missing' in capsys.readouterr().out
    assert command.run(arguments(places, *options)) == 0
    assert '1 of 1 runs are done' in capsys.readouterr().out and pages == [False, True]
    assert command.run(arguments(places, *options, '--list')) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and run.name in lines[1] and 'done' in lines[1]
    error = np.mean(find_state(run, places).result['evaluation']['prediction']['min_l1'])
    assert f'{error:.4f}' in lines[1]
    assert command.run(arguments(places, '--list')) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(paper_runs('small'))
