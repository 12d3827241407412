# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the paper's runs, of a tiny sweep over some, and of the numbers made of their scores."""

import copy
from dataclasses import replace
from functools import partial
import json
from pathlib import Path

from experiments.paper import command, runs, sweep
from experiments.paper.methods import method_fields
from experiments.paper.recordings import RECORDINGS, SHIFTED
from experiments.paper.results import load_runs, on_same_episodes
from experiments.paper.rows import as_frame, group_runs, make_rows
from experiments.paper.runs import FINE_TUNED, paper_runs, PaperRun, PAST_VARIANTS
from experiments.paper.sweep import find_result, Places
from made_episodes import move_squares, write_bag
import numpy as np
import pytest
from tap_ros.base.errors import ConfigError
from tap_ros.base.options import parse

STORED = Path(__file__).parents[2] / 'docs' / 'results' / 'runs'
SEEDS = (122, 142, *range(4), 6, 8)  # the first two are held out
WARPING = PaperRun('push2', 'bidirectional', 'genmin-wo-gan', new_pixels=False)
PAINTING = replace(WARPING, new_pixels=True)
SAMPLED = replace(PAINTING, method='genmin-vae')
FORWARD = replace(WARPING, mode='forward', method='genmin2')
FAILING = replace(WARPING, task='grasp')


def test_every_run_has_a_name_of_its_own_and_is_trained_as_that_says():
    every = paper_runs()
    assert len({run.name for run in every}) == len(every)
    assert [run.seed for run in every] == sorted(run.seed for run in every)
    for run in every:
        config = run.config('bags', 'runs/paper')
        assert method_fields(config.method) == method_fields(run.method)
        assert (config.mode, config.seed) == (run.mode, run.seed)
        assert config.goal_picture == ('mixed' if run.task in FINE_TUNED else 'last')
        assert config.skips == (config.decoder == 'shared') == ('+skips' in run.variant)
        if 'progress' not in run.method and 'margin' not in run.variant:
            assert config.margin == 0


def test_the_stored_results_are_those_of_today():
    places = Places(results=str(STORED.parent))
    done = {run.name for run in paper_runs() if find_result(run, places)}
    assert done == {path.stem for path in STORED.glob('small/*.json')
                    if not any(past in path.stem for past in PAST_VARIANTS)}


@pytest.fixture(scope='module')
def places(tmp_path_factory):
    """Sweep over small runs, one of which fails; return where, and what was said of failures."""
    folder, patch = tmp_path_factory.mktemp('paper'), pytest.MonkeyPatch()
    patch.setattr(sweep, 'run_tasks', lambda tasks, *_: (  # pools have tests of their own
        (task, partial(task.function, *task.args)) for task in tasks))
    patch.setattr(runs, 'STEPS', 2)
    patch.setattr(runs, '_SMALL', {'base_width': 4, 'batch_size': 4, 'threads': 1})
    patch.setitem(RECORDINGS, 'push2', replace(RECORDINGS['push2'], episodes=len(SEEDS)))
    for name, seeds in {'push2': SEEDS, 'grasp': [0], **dict.fromkeys(SHIFTED, SEEDS)}.items():
        starts = [np.random.default_rng(seed).uniform(3, 7, (2, 2)) for seed in seeds]
        write_bag(folder / 'bags' / name, [
            move_squares(at, at + 5, length=7, size=16, half=1, seed=seed, task=name)
            for at, seed in zip(starts, seeds)])
    places = Places(*(str(folder / name) for name in ('bags', 'runs', 'results')))
    every = [FAILING, WARPING, PAINTING, SAMPLED, FORWARD]
    failed = sweep.sweep(every, places)  # one episode: none can be held out
    assert list(failed) == [FAILING.name] and 'grasp' in str(failed[FAILING.name])
    assert not sweep.sweep(every[1:], replace(places, recordings='nowhere'))  # all are done
    yield places
    patch.undo()


def test_a_run_leaves_a_number_for_every_held_out_episode(places):
    scores = {run.name: find_result(run, places)['evaluation'] for run in (
        WARPING, PAINTING, SAMPLED, FORWARD)}
    assert all(len(values) == 2 for method in ('prediction', 'copy-start', 'copy-goal')
               for values in scores[WARPING.name][method].values())
    sampled, painting = scores[SAMPLED.name], scores[PAINTING.name]
    assert all(best <= one for best, one in zip(
        sampled['best_of_100']['min_l1'], sampled['prediction']['min_l1']))
    first, second = painting['recursion']
    assert first['min_l1'] == painting['prediction']['min_l1'] != second['min_l1']
    assert 'copy-goal' not in scores[FORWARD.name]
    assert find_result(replace(WARPING, seed=1), places) is None
    path = places.result(FORWARD)
    path.write_text('{"torn": ')
    assert find_result(FORWARD, places) is None
    with pytest.raises(ConfigError, match=path.name):
        load_runs(path.parents[1])
    path.unlink()


def test_the_command_does_what_fits_the_pattern_and_writes_the_results(places, capsys):
    def run(*words):
        found = command.run(parse(command.Options, [
            '--recordings', places.recordings, '--runs', places.runs,
            '--results', places.results, *words]))
        return found, capsys.readouterr().out

    first = paper_runs()[0]
    assert run('--only', first.name) == (0, '1 of 1 runs are done\n')
    code, out = run('--list')
    assert code == 0 and len(out.splitlines()) == 1 + len(paper_runs())
    error = np.mean(find_result(first, places)['evaluation']['prediction']['min_l1'])
    assert any(first.name in line and f'{error:.4f}' in line for line in out.splitlines())
    assert first.name in Path(places.results, 'prediction.csv').read_text()
    with pytest.raises(ConfigError, match='no run has such a name'):
        run('--only', 'nothing*')


@pytest.fixture
def stored():
    """Return the runs of grasping by fix and by min."""
    return [json.loads((STORED / 'small' / f'grasp-bidirectional-{name}-s0.json').read_text())
            for name in ('fix', 'min')]


def test_gains_are_paired_by_episode(stored):
    # Errors differ a lot between episodes, but one method's are always half of the other's.
    fix, half = (run['evaluation']['prediction'] for run in stored)
    half['min_l1'] = [error / 2 for error in fix['min_l1']]
    rows = as_frame(make_rows(group_runs(stored)))
    gain = rows[(rows.method == 'min') & (rows.metric == 'gain_over_fix')].iloc[0]
    assert [gain.value, gain.ci_low, gain.ci_high] == pytest.approx([0.5] * 3)
    assert gain.baseline == 'fix'


def test_numbers_of_other_episodes_are_left_out(stored):
    other = copy.deepcopy(stored[1])
    other['evaluation']['copy-start']['min_l1'][7] += 1e-5
    assert on_same_episodes([*stored, other]) == (stored, [other])
