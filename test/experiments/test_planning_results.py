# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the planning results: resumed, paired, refused when damaged; the whole command."""

from dataclasses import asdict, replace
from functools import partial
import json
from pathlib import Path

from experiments.__main__ import LINE
from experiments.planning import runs
from experiments.planning.methods import parse_method
from experiments.planning.results import make_rows, make_stack_rows
from experiments.planning.runs import (
    Job,
    load_results,
    read_results,
    ResultFile,
    run_jobs,
    SPEED_ONLY,
)
import pytest
from tap_ros.apps.cli import main
from tap_ros.base.errors import ConfigError
from tap_ros.planning.mpc_config import VisualMPCConfig, with_preset
from tap_ros.planning.protocols import SearchConfig
from tap_ros.weights import PREDICTORS

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / 'docs' / 'results'
SMALL = VisualMPCConfig(search=SearchConfig(8, 1, 4), proposals=4, batch_size=8, threads=1)


def run_here(tasks, *_):
    """Run tasks in this process: pools of processes have tests of their own."""
    return ((task, partial(task.function, *task.args)) for task in tasks)


def job(name, planner=SMALL, task='push2', **changes):
    return Job(task, parse_method(name), planner, **changes)


def stored(name, finals, first=0, task='push2'):
    """Return results of scenes that end so many cm away; of stacking less than 5 is a success."""
    own = job(name, task=task)
    scenes = {first + i: {'seed': first + i, 'final_cm': cm, 'objects_cm': [cm, cm], 'steps': 40}
              for i, cm in enumerate(finals)}
    for scene in scenes.values():
        scene |= {'success': scene['final_cm'] < 5, 'first_right': True, 'moves': 2,
                  'seconds': 1.0} if own.stacks else {
                      'plan_ms': None if name == 'nothing' else 5.0}
    return (task, name), (own.settings() | own.about, scenes)


def test_an_evaluation_goes_on_where_it_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, 'run_tasks', run_here)
    jobs = [job('nothing'), job('direct:steps1'), job('nothing', task='stack2')]
    first = run_jobs(jobs, [7], tmp_path, progress=False)
    text = first[0].path.read_text()
    first[0].path.write_text(text.replace('"final_cm": 20.0', '"final_cm": 99.0'))
    both = run_jobs(jobs, [7, 8], tmp_path, progress=False)
    assert [sorted(file.scenes) for file in both] == 3 * [[7, 8]]
    assert both[0].scenes[7]['final_cm'] == 99.0  # it was not run again
    assert not list(tmp_path.rglob('*.part'))
    assert [path.name for path in (tmp_path / 'stacking').iterdir()] == ['stack2-nothing.json']


def test_other_settings_are_refused_and_speed_is_none(tmp_path):
    scene = stored('direct', [9.0])[1][1][0]
    ResultFile(tmp_path, job('direct')).add(scene)
    for changed in ({'proposals': 5}, {'solver': 'icem'}):
        with pytest.raises(ConfigError, match='planner'):
            ResultFile(tmp_path, job('direct', replace(SMALL, **changed)))
    assert ResultFile(tmp_path, job('direct', replace(SMALL, batch_size=3, threads=2))).scenes
    old = job('shipped', task='stack2', predictor=str(PREDICTORS['stack2']))
    ResultFile(tmp_path, old).add(scene)
    for changed in ({'predictor': str(PREDICTORS['stack3'])}, {'look': 'ur10e'}):
        with pytest.raises(ConfigError, match='other settings'):
            ResultFile(tmp_path, replace(old, **changed))


def test_published_results_were_made_with_the_planner_of_today():
    for path in sorted((RESULTS / 'planning').glob('*.json')):
        settings, scenes = read_results(path)
        method = parse_method(settings['method'])
        planner = asdict(method.planner(with_preset(settings['preset'])))
        assert planner.pop('solver') == 'cem' and scenes
        assert settings['planner'] == {k: v for k, v in planner.items() if k not in SPEED_ONLY}


def test_published_numbers_are_made_from_the_scenes():
    for name, make in (('planning', make_rows), ('stacking', make_stack_rows)):
        assert make(load_results(RESULTS / name)) == json.loads(
            (RESULTS / f'{name}.json').read_text())


def test_damaged_files_are_named_and_kept(tmp_path):
    file = ResultFile(tmp_path, job('direct'))
    file.add(stored('direct', [9.0])[1][1][0])
    good = file.path.read_text()
    for text in (good[:len(good) // 2], '', '[]', good.replace('final_cm', 'finale')):
        file.path.write_text(text)
        for read in (lambda: read_results(file.path), lambda: ResultFile(tmp_path, job('direct'))):
            with pytest.raises(ConfigError, match=f'{file.path}: is damaged'):
                read()
        assert file.path.read_text() == text


def test_results_of_other_settings_are_not_subtracted():
    results = dict([stored('direct', [9.0]), stored('genmin', [4.0])])
    for changes in ({'preset': 'large'}, {'preset': '', 'planner': {'clearance': 0.2}}):
        settings = results['push2', 'direct'][0]
        settings['planner'] |= changes.pop('planner', {})
        settings |= changes
        assert not any('against' in row for row in make_rows(results))
    results = dict([stored('direct', [9.0]), stored('direct:steps60', [4.0])])
    assert {r['compares'] for r in make_rows(results) if 'against' in r} == {'step_budget'}
    results = dict([stored('genmin', [9.0]), stored('genmin:tracked', [4.0])])
    assert any('against' in row for row in make_rows(results))
    results['push2', 'genmin'][0]['predictor_weights'] = 'others'
    assert not any('against' in row for row in make_rows(results))


def test_the_command_leaves_numbers_and_films_and_runs_nothing_again(
        tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(runs, 'run_tasks', run_here)
    out = tmp_path / 'results'
    words = ['planning', '--tasks', 'push2', 'stack2', '--methods', 'nothing',
             'direct:steps2', 'shipped:tracked:steps2', '--scenes', '1',
             '--out', str(out), '--preset', 'quick', '--solver', 'icem']
    assert main(LINE, words) == 0
    rows = json.loads((out / 'planning.json').read_text())
    assert {row['method'] for row in rows} == {
        'nothing', 'direct:steps2', 'shipped:tracked:steps2'}
    tracked = [row for row in rows if row['method'] == 'shipped:tracked:steps2']
    assert {row['step_budget'] for row in tracked} == {2}
    assert {row['tracking'] for row in tracked} == {'rigid'}
    assert 'tracking_error_px' in {row['metric'] for row in tracked}
    assert '--methods shipped:tracked:steps2 --scenes 1' in tracked[0]['command']
    assert '--solver icem' in tracked[0]['command']
    for film in ('planning/push2-direct--steps2.png', 'stacking/stack2-direct--steps2.png'):
        assert (out / film).read_bytes().startswith(b'\x89PNG')
    files = {path: path.stat().st_mtime_ns for path in out.rglob('*-*.json')}
    assert main(LINE, [*words, '--no-films']) == 0 and main(LINE, [*words, '--results-only']) == 0
    assert files == {path: path.stat().st_mtime_ns for path in files}  # nothing is run again
    assert main(LINE, [*words, '--methods', 'unheard_of']) == 1
    assert '--predictor unheard_of=FILE' in capsys.readouterr().err
