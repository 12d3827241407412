# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the sweep, with tiny recordings and a few steps of training."""

from dataclasses import replace
from functools import partial
import json
import os
from pathlib import Path
import subprocess
import sys

from experiments.paper import command
from experiments.paper import sweep as sweep_module
from experiments.paper.job import BUSY, DONE, perform, UNFINISHED
from experiments.paper.places import (
    Places,
    recording_hash,
)
from experiments.paper.recordings import held_out_share, SHIFTED
from experiments.paper.recursion import way_behind
from experiments.paper.runs import paper_runs, PaperRun, SCALES
from experiments.paper.sweep import find_state, sweep
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.engines import Engine
from tap_ros.errors import ConfigError
from tap_ros.files import locked
from tap_ros.options import parse
from tap_ros.prediction.methods import method_fields
from tap_ros.recording.cache import open_recordings
from tap_ros.training.split import split_episodes

ROOT = Path(__file__).parents[2]
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


@pytest.fixture(autouse=True)
def package(monkeypatch):
    """Let jobs find the package."""
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])]))


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
    assert result['data'] == {
        'hash': store.data_hash, 'episodes': EPISODES - held_out, 'held_out': held_out,
        'shifted': {name: recording_hash(places.recording(name)) for name in SHIFTED}}
    scores = result['evaluation']
    assert (scores['margin'], scores['goal_picture']) == (0, 'last')
    for method in ('prediction', 'copy-start', 'copy-goal'):
        assert {name: len(values) for name, values in scores[method].items()} == dict.fromkeys(
            ('min_l1', 'match_step', 'match_fraction', 'changed_l1', 'bottleneck',
             'object_mass', 'hand', 'objects'), held_out)
    for name, count in {'arm_elsewhere': held_out, **dict.fromkeys(SHIFTED, EPISODES)}.items():
        for method in ('prediction', 'copy-goal'):
            assert len(scores['shifted'][name][method]['min_l1']) == count
    assert len(scores['bottleneck_at']) == held_out
    assert result['training']['steps'] == 2
    assert method_fields(RUN.method).items() <= result['config'].items()
    assert result['name'] == RUN.name and RUN.name in result['command']


def test_samples_and_forward_prediction_are_scored(places, small):
    vae = replace(RUN, method='genmin-vae', new_pixels=True)
    forward = replace(RUN, mode='forward', method='genmin2')
    assert perform(vae, places) == perform(forward, places) == DONE
    scores = find_state(vae, places).result['evaluation']
    best, single = scores['best_of_100']['min_l1'], scores['prediction']['min_l1']
    assert all(a <= b for a, b in zip(best, single))
    assert all(spread >= 0 for spread in scores['sample_spread'])
    assert len(scores['sample_spread_near']) == len(scores['sample_spread_elsewhere']) == len(
        single)
    assert scores['sample_spread_px'] == [None] * len(single)
    scores = find_state(forward, places).result['evaluation']
    assert 'copy-start' in scores and 'copy-goal' not in scores


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


def test_a_training_goes_on_where_it_stopped(places, small):
    longer = replace(RUN, steps=3)
    assert perform(longer, places, minutes=1e-9) == UNFINISHED
    assert find_state(longer, places).steps == 1
    assert not places.result(longer).exists()
    assert perform(longer, places) == DONE
    with pytest.raises(ConfigError, match='steps'):
        perform(RUN, places)
    assert perform(RUN, places, fresh=True) == DONE


def test_nobody_trains_what_another_process_is_at(places):
    holder = subprocess.Popen(
        [sys.executable, '-c', 'import sys; from tap_ros.files import locked\n'
         f'with locked({str(RUN.folder(places.runs) / "lock")!r}) as mine:\n'
         '    print(mine, flush=True); sys.stdin.read()'],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b'True\n'
    assert perform(RUN, places) == BUSY
    holder.kill()
    holder.wait()
    with locked(RUN.folder(places.runs) / 'lock') as mine:
        assert mine


@pytest.mark.slow
def test_one_failed_run_does_not_stop_the_others(places):
    write_squares(Path(places.recordings) / 'grasp', [0])  # one episode: none can be held out
    bad = replace(RUN, task='grasp')
    calls = []
    ends = sweep([bad, RUN], places, Engine(workers=2), on_done=lambda: calls.append(1),
                 progress=False)
    assert {end.name: end.kind for end in ends} == {bad.name: 'failed', RUN.name: 'done'}
    assert len(calls) == 1
    failed = next(end for end in ends if end.kind == 'failed')
    assert failed.reason.startswith('error: ') and 'grasp' in failed.reason
    assert sweep([RUN], places, progress=False) == []


def test_recursion_is_scored_where_the_network_paints(places, small):
    painting = replace(RUN, new_pixels=True)
    assert perform(RUN, places) == perform(painting, places) == DONE
    assert 'recursion' not in find_state(RUN, places).result['evaluation']
    scores = find_state(painting, places).result['evaluation']
    first, second = scores['recursion']
    assert first['min_l1'] == scores['prediction']['min_l1']
    assert first['match_step'] == scores['prediction']['match_step']
    assert len(second['way']) == 2 and second['min_l1'] != first['min_l1']


def test_the_way_behind_is_a_share_of_what_moves():
    pixels = np.zeros((5, 2, 2))
    pixels[:, 0, 0] = [10, 10, 15, 25, 30]  # the other object stays
    assert [way_behind(pixels, t) for t in range(5)] == [0, 0, 0.25, 0.75, 1]
    pixels[3, 0, 0] = 35  # beyond the goal
    assert way_behind(pixels, 3) == 1
    assert np.isnan(way_behind(pixels[:2], 1)) and np.isnan(way_behind(pixels * np.nan, 1))


def arguments(places, *options):
    return parse(command.Options, [
        '--recordings', places.recordings, '--runs', places.runs, '--results', places.results,
        '--episodes', str(EPISODES), '--steps', '2', *options])


@pytest.mark.slow
def test_the_command_lists_and_does_what_fits_the_pattern(places, capsys, monkeypatch):
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
