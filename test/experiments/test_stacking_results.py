# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the stacking results: resumed, paired, refused when damaged; the whole command."""

import json

from experiments.planning.runs import ResultFile, run_jobs
from experiments.stacking.command import DEFAULT_METHODS, FIRST_SCENE
from experiments.stacking.films import pick_scenes
from experiments.stacking.methods import parse_method
from experiments.stacking.page import make_page
from experiments.stacking.results import make_rows
from experiments.stacking.runs import Job, run_scene
import pytest
from tap_ros.cli import main
from tap_ros.errors import ConfigError
from tap_ros.weights import PREDICTORS


def job(name, **changed):
    return Job('stack2', parse_method(name), command='do it', **changed)


def stored(name, successes, first=0, task='stack3'):
    scenes = {first + i: {
        'seed': first + i, 'success': bool(good), 'first_right': bool(good), 'moves': 2,
        'final_cm': 6.0 - 5 * good, 'objects_cm': [0.0, 1.0, 1.0], 'steps': 40, 'seconds': 1.0}
        for i, good in enumerate(successes)}
    own = Job(task, parse_method(name))
    return (task, name), (own.settings() | own.about, scenes)


def find(rows, method, metric, against=None):
    row, = (row for row in rows if (row['method'], row['metric'], row.get('against')) == (
        method, metric, against))
    return row


def test_an_evaluation_goes_on_where_it_stopped(tmp_path):
    jobs = [job('nothing'), job('direct')]
    first = run_jobs(jobs, [7], tmp_path, progress=False, run=run_scene)
    text = first[1].path.read_text()
    first[1].path.write_text(text.replace('"moves": 1', '"moves": 99'))
    both = run_jobs(jobs, [7, 8], tmp_path, progress=False, run=run_scene)
    assert [sorted(file.scenes) for file in both] == [[7, 8], [7, 8]]
    assert both[1].scenes[7]['moves'] == 99  # it was not run again
    settings = json.loads(first[1].path.read_text())['settings']
    assert settings['command'] == 'do it' and settings['machine'] and settings['date']


def test_results_of_other_weights_or_another_look_are_refused(tmp_path):
    old = job('shipped', predictor=str(PREDICTORS['stack2']))
    ResultFile(tmp_path, old).add(stored('shipped', [1])[1][1][0])
    assert ResultFile(tmp_path, old).scenes
    for changed in ({'predictor': str(PREDICTORS['stack3'])}, {'look': 'ur10e'}):
        with pytest.raises(ConfigError, match='other settings'):
            ResultFile(tmp_path, job('shipped', **{'predictor': old.predictor} | changed))


def test_differences_are_paired_over_the_scenes_that_both_have():
    rows = make_rows(dict([stored('direct', [1, 0, 0, 1]), stored('shipped', [1, 1, 1], 1)]))
    assert find(rows, 'direct', 'success')['value'] == 0.5
    assert find(rows, 'direct', 'success')['n'] == 4
    more = find(rows, 'shipped', 'success_difference', 'direct')
    assert more['n'] == 3 and more['value'] == pytest.approx(2 / 3, abs=1e-4)
    assert find(rows, 'shipped', 'success')['ci_low'] < 0.5  # all of three prove little
    assert not [row for row in rows if row['method'] == 'direct' and 'against' in row]


def test_results_of_another_look_or_task_are_not_compared():
    other, (settings, scenes) = stored('direct', [1, 0])
    for results in ({other: (settings | {'look': 'ur10e'}, scenes)},
                    dict([stored('direct', [1, 0], task='stack2')])):
        rows = make_rows(results | dict([stored('shipped', [1, 1])]))
        assert 'success_difference' not in {row['metric'] for row in rows}


def test_the_page_shows_each_task_and_its_methods_in_order():
    rows = make_rows(dict([
        stored('true_places', [1, 1]), stored('shipped', [1, 1]), stored('direct', [1, 0]),
        stored('shipped', [1, 0], task='stack2')]))
    page = make_page(rows, {('stack3', 'shipped'): 'stacking/x.png'}, 'We found x.')
    lines = [line for line in page.splitlines() if line.startswith('| `')]
    assert [line.split('`')[1] for line in lines] == [
        'direct', 'shipped', 'true_places', 'shipped']
    assert '| 100% (34 to 100) | +50 (' in lines[1] and '(stacking/x.png)' in page
    assert page.index('We found x.') < page.index('## A tower of three blocks')


def test_pictures_show_scenes_that_succeed_and_scenes_that_fail():
    scenes = stored('direct', [0, 1, 0, 1, 1, 0, 0, 0])[1][1]
    assert pick_scenes(scenes) == [1, 0, 2, 5]


@pytest.mark.slow
def test_the_command_leaves_numbers_page_and_pictures(tmp_path, capsys):
    out = tmp_path / 'results'
    words = ['evaluate', 'stacking', '--tasks', 'stack2', '--methods', 'nothing', 'direct',
             'shipped', '--scenes', '2', '--jobs', '2', '--out', str(out)]
    assert main(words) == 0
    rows = json.loads((out / 'stacking.json').read_text())
    assert {row['method'] for row in rows} == {'nothing', 'direct', 'shipped'}
    row = find(rows, 'shipped', 'success')
    assert row['n'] == 2 and row['first_scene'] == FIRST_SCENE and row['predictor_weights']
    assert row['machine'] and row['date'] and '--methods shipped --scenes 2' in row['command']
    assert find(rows, 'nothing', 'success')['value'] == 0
    assert (out / 'stacking' / 'stack2-shipped.png').read_bytes().startswith(b'\x89PNG')
    page = (out / 'stacking.md').read_text()
    assert 'stacking/stack2-shipped.png' in page and '| `nothing` | 0%' in page
    assert main([*words, '--results-only']) == 0
    assert (out / 'stacking.md').read_text() == page
    capsys.readouterr()
    assert main([*words, '--methods', 'unheard_of']) == 1
    assert '--predictor unheard_of=FILE' in capsys.readouterr().err


def test_the_usual_methods_are_left_out_where_there_are_no_weights_of_them(
        tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(['evaluate', 'stacking', '--tasks', 'stack2', '--scenes', '1', '--out',
                 'results', '--no-films']) == 0
    said = capsys.readouterr().out
    rows = json.loads((tmp_path / 'results' / 'stacking.json').read_text())
    methods = {row['method'] for row in rows}
    assert {'direct', 'shipped', 'true_subgoals'} < methods < set(DEFAULT_METHODS)
    for name in set(DEFAULT_METHODS) - methods:
        assert f"left out: method '{name}': no weights runs/paper" in said
    assert 'stack2-bidirectional-genmin-wo-gan+progress+skips-r2-s0' in said
    assert main(['evaluate', 'stacking', '--methods', 'fix']) == 1
    assert 'python -m tap_ros paper --only' in capsys.readouterr().err
    assert main(['evaluate', 'stacking', '--results-only']) == 1
    assert 'holds no results' in capsys.readouterr().err
