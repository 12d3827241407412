# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the planning results: resumed, paired, refused when damaged; the whole command."""

from dataclasses import asdict, replace
import json
from pathlib import Path

from experiments.planning.films import make_caption, pick_scenes
from experiments.planning.methods import parse_method
from experiments.planning.page import make_page
from experiments.planning.results import make_rows, partners
from experiments.planning.runs import (
    Job,
    read_results,
    ResultFile,
    run_jobs,
    SPEED_ONLY,
)
import pytest
from tap_ros.cli import main
from tap_ros.errors import ConfigError
from tap_ros.evaluation import forward
from tap_ros.planning.cem import CEMConfig
from tap_ros.planning.mpc_config import VisualMPCConfig, with_preset
from tap_ros.recording.reader import iter_episodes
from tap_ros.weights import FORWARD_MODEL

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'
PUBLISHED = Path(__file__).parents[2] / 'docs' / 'results' / 'planning'
SMALL = VisualMPCConfig(search=CEMConfig(8, 1, 4), proposals=4, batch_size=8, threads=1)


def job(name, planner=SMALL):
    return Job('push2', parse_method(name), planner, str(FORWARD_MODEL))


def stored(name, finals, first=0):
    scenes = {first + i: {'seed': first + i, 'final_cm': cm, 'objects_cm': [cm, cm],
                          'steps': 40, 'plan_ms': None if name == 'nothing' else 5.0}
              for i, cm in enumerate(finals)}
    return ('push2', name), (job(name).settings(), scenes)


def test_an_evaluation_goes_on_where_it_stopped(tmp_path):
    jobs = [job('nothing'), job('direct:steps1')]
    first = run_jobs(jobs, [7], tmp_path, progress=False)
    text = first[0].path.read_text()
    first[0].path.write_text(text.replace('"final_cm": 20.0', '"final_cm": 99.0'))
    both = run_jobs(jobs, [7, 8], tmp_path, progress=False)
    assert [sorted(file.scenes) for file in both] == [[7, 8], [7, 8]]
    assert both[0].scenes[7]['final_cm'] == 99.0  # it was not run again
    assert not list(tmp_path.glob('*.part'))


def test_other_settings_are_refused_and_speed_is_none(tmp_path):
    ResultFile(tmp_path, job('direct')).add(stored('direct', [9.0])[1][1][0])
    with pytest.raises(ConfigError, match='planner'):
        ResultFile(tmp_path, job('direct', replace(SMALL, proposals=5)))
    faster = job('direct', replace(SMALL, batch_size=3, threads=2))
    assert ResultFile(tmp_path, faster).scenes


@pytest.mark.parametrize('path', sorted(PUBLISHED.glob('*.json')), ids=lambda path: path.stem)
def test_published_results_were_made_with_the_planner_of_today(path):
    settings, scenes = read_results(path)
    method = parse_method(settings['method'])
    planner = asdict(method.planner(with_preset(settings['preset'])))
    assert settings['planner'] == {k: v for k, v in planner.items() if k not in SPEED_ONLY}
    assert scenes


@pytest.mark.parametrize('damage', [
    lambda text: text[:len(text) // 2], lambda text: '', lambda text: '[]',
    lambda text: text.replace('final_cm', 'finale')])
def test_damaged_files_are_named_and_kept(tmp_path, damage):
    file = ResultFile(tmp_path, job('direct'))
    file.add(stored('direct', [9.0])[1][1][0])
    text = damage(file.path.read_text())
    file.path.write_text(text)
    with pytest.raises(ConfigError, match=str(file.path)):
        read_results(file.path)
    with pytest.raises(ConfigError, match='damaged'):
        ResultFile(tmp_path, job('direct'))
    assert file.path.read_text() == text


def test_rows_are_means_with_intervals_and_paired_differences():
    results = dict([stored('direct', [10.0, 14.0, 12.0]), stored('fix', [12.0, 16.0], 1),
                    stored('genmin', [4.0, 8.0, 6.0]), stored('nothing', [20.0]),
                    stored('genmin:true_maps', [2.0, 6.0, 4.0])])
    rows = {(r['method'], r['metric'], r.get('against')): r for r in make_rows(results)}
    assert {r['compares'] for r in rows.values() if r.get('against') == 'genmin'} == {'maps'}
    direct = rows['direct', 'final_distance_cm', None]
    assert direct['value'] == 12 and direct['n'] == 3 and direct['seeds'] == 1
    assert direct['ci_low'] <= 12 <= direct['ci_high']
    assert direct['standard_error'] == pytest.approx(2 / 3 ** 0.5, abs=1e-4)
    gain = rows['genmin', 'final_distance_difference_cm', 'direct']
    assert gain['value'] == gain['ci_low'] == gain['ci_high'] == -6  # in each scene
    replaced = rows['genmin:true_maps', 'final_distance_difference_cm', 'genmin']
    assert replaced['value'] == pytest.approx(-2)
    paired = rows['genmin', 'final_distance_difference_cm', 'fix']
    assert paired['n'] == 2 and paired['value'] == pytest.approx((8 - 12 + 6 - 16) / 2)
    assert rows['genmin', 'success_5cm', None]['value'] == pytest.approx(1 / 3, abs=1e-4)
    more = rows['genmin', 'success_5cm_difference', 'direct']
    assert more['value'] == pytest.approx(1 / 3, abs=1e-4) and more['n'] == 3
    assert ('direct', 'final_distance_difference_cm', 'direct') not in rows
    assert ('nothing', 'plan_ms', None) not in rows
    assert all(row['tracking'] == 'ground_truth' for row in rows.values())


def test_methods_are_compared_in_the_same_planner():
    names = {'direct', 'direct:paper', 'true_model', 'fix', 'fix:half', 'genmin', 'genmin:half',
             'genmin:half:paper', 'genmin:true_model', 'true_subgoal', 'nothing',
             'direct:plain_cost', 'genmin:plain_cost'}

    def compared(name):
        return dict(partners(parse_method(name), names))

    assert compared('genmin:half:paper') == {'direct': 'direct:paper', 'search': 'genmin:half'}
    assert compared('genmin:half') == {'direct': 'direct', 'fix': 'fix:half', 'switch': 'genmin'}
    assert compared('genmin:true_model') == {'direct': 'true_model', 'model': 'genmin'}
    assert compared('true_model') == {'model': 'direct'}
    assert compared('genmin:plain_cost') == {'direct': 'direct:plain_cost', 'cost': 'genmin'}
    assert partners(parse_method('true_subgoal'), names)[2:] == [
        ('subgoal', 'fix'), ('subgoal', 'genmin')]
    assert compared('nothing') == {}
    names |= {'fix:rounds2', 'shipped:rounds2', 'shipped', 'fix+scratch', 'fix+late'}
    assert compared('shipped:rounds2')['fix'] == 'fix:rounds2'
    names |= {'fix+rounds', 'fix+rounds:rounds2'}
    assert compared('shipped:rounds2')['fix'] == 'fix+rounds:rounds2'
    assert compared('shipped')['fix'] == 'fix' and 'fix' not in compared('fix+rounds')
    assert compared('genmin+relative+scratch')['fix'] == 'fix+scratch'
    assert compared('genmin+relative+late')['fix'] == 'fix+late'
    names.add('direct:twice')
    assert compared('genmin')['direct, twice'] == 'direct:twice'
    assert compared('direct:twice') == {'search': 'direct'}
    assert 'direct, twice' not in {**compared('genmin:half:paper'), **compared('direct')}
    names |= {'direct:steps60', 'genmin:steps60'}
    assert compared('genmin:steps60') == {'direct': 'direct:steps60', 'step_budget': 'genmin'}


def test_results_of_other_settings_are_not_subtracted():
    results = dict([stored('direct', [9.0]), stored('genmin', [4.0])])
    results['push2', 'direct'][0]['preset'] = 'large'
    assert not any('against' in row for row in make_rows(results))
    results['push2', 'direct'][0].update(preset='', planner={**asdict(SMALL), 'clearance': 0.2})
    assert not any('against' in row for row in make_rows(results))
    results = dict([stored('direct', [9.0]), stored('genmin:steps60', [4.0])])
    assert not any('against' in row for row in make_rows(results))
    results = dict([stored('direct', [9.0]), stored('direct:steps60', [4.0])])
    assert {r['compares'] for r in make_rows(results) if 'against' in r} == {'step_budget'}
    results = dict([stored('genmin', [9.0]), stored('genmin:true_maps', [4.0])])
    assert any('against' in row for row in make_rows(results))
    results['push2', 'genmin'][0]['predictor_weights'] = 'others'
    assert not any('against' in row for row in make_rows(results))


def test_claims_follow_the_numbers():
    results = dict([stored('direct', [3.0, 4.0, 9.0]), stored('shipped', [2.0, 2.0, 3.0])])
    rows = make_rows(results)
    page = make_page(rows, {})

    def cells(start):
        line, = [line for line in page.splitlines() if line.startswith(f'| {start}')]
        return [cell.strip() for cell in line.strip('|').split('|')]

    assert cells('final distance via the subgoal, two')[1:] == [
        '11.9 cm', 'at most 2.5 cm', '2.3 cm (2.0 to 3.0), 3 scenes', 'yes']
    less = cells('the same, minus direct, two objects')
    assert less[1] == '-1.0 cm' and less[3].startswith('-3.0 cm (') and less[4] == 'yes'
    assert cells('final distance via the subgoal, three')[3:] == ['-', '*not run*']
    ordered = [{**row, 'task': 'order2'} for row in rows]
    page = make_page(ordered, {})
    more = cells('success via the subgoal minus direct, two, one on')
    assert more[3].startswith('+33 points (') and more[4] == 'no', 'the interval begins at 0'
    late = make_rows(dict([stored('fix+late', [9.0, 4.0, 9.0]),
                           stored('genmin+relative+late', [2.0, 2.0, 3.0])]))
    page = make_page([{**row, 'task': 'order2'} for row in late], {})
    assert cells('success via the subgoal minus via the subgoal of `fix`, both trained on late')[
        3].startswith('+67 points (')
    twice = [{**row, 'task': 'order3', 'method': row['method'].replace(
        'shipped', 'shipped:rounds2')} for row in rows]
    page = make_page(twice, {})
    assert cells('success via the subgoal minus direct, three')[3].startswith('+33 points (')
    page = make_page([{**row, 'task': 'order3'} for row in rows], {})
    assert cells('success via the subgoal minus direct, three')[4] == '*not run*'


def test_the_page_shows_the_papers_numbers_beside_ours():
    rows = make_rows(dict([stored('direct', [10.0, 14.0]), stored('genmin:half', [4.0, 8.0])]))
    page = make_page(rows, {('push2', 'direct'): ('planning/x.png', 'three scenes')})
    line, = [line for line in page.splitlines() if line.startswith('| `direct`')]
    assert '12.9 ± 0.6' in line and '12.0 [10.0, 14.0]' in line and '| 2 |' in line
    line, = [line for line in page.splitlines() if line.startswith('| `genmin:half`')]
    assert '-6.0 [-6.0, -6.0]' in line and '![direct](planning/x.png)' in page


def test_the_page_tells_what_replacing_a_part_changes_and_how_good_the_maps_are():
    rows = make_rows(dict([stored('genmin', [4.0, 8.0]), stored('genmin:true_maps', [2.0, 6.0])]))
    measured = {5: {'map_error': [1.0, 2.0], 'nothing_moves': [6.0, 6.0],
                    'true_simulator': [0.1, 0.1]}}
    page = make_page(rows, {}, forward.make_rows('push3', measured, 'abc', 'do it'), 'We found x.')
    assert '| its maps | `genmin:true_maps` | `genmin` | -2.0 [-2.0, -2.0] | 2 |' in page
    assert '| push3 | forward_model | 1.50 [1.00, 2.00], n = 2 |' in page
    assert page.index('We found x.') < page.index('## Two objects')


def test_forward_models_are_scored_beside_standing_still(tmp_path, capsys):
    words = ['evaluate', 'forward', '--recordings', str(SAMPLE), '--out', str(tmp_path)]
    assert main([*words, '--test-fraction', '1']) == 0
    rows = json.loads((tmp_path / forward.FILE).read_text())
    last = {row['method']: row['value'] for row in rows if row['step'] == 15}
    assert last['true_simulator'] < last['forward_model'] < last['nothing']
    assert {row['task'] for row in rows} == {SAMPLE.name}
    assert main([*words, '--test-fraction', '0']) == 1
    assert '--test-fraction 1' in capsys.readouterr().err


def test_films_show_the_best_the_median_and_the_worst_scene():
    scenes = {seed: {'final_cm': cm} for seed, cm in enumerate([3.0, 9.0, 1.0, 5.0, 7.0])}
    assert pick_scenes(scenes) == [2, 3, 1]
    assert pick_scenes({4: {'final_cm': 3.0}}) == [4, 4, 4]
    assert make_caption(scenes, True) == (
        'the best, the median and the worst of 5 scenes: 1.0 cm (scene 2), 5.0 cm (scene 3) and '
        '9.0 cm (scene 1). Each row: 10 pictures from the first to the last, then each predicted '
        'subgoal, and the goal')
    assert 'subgoal' not in make_caption(scenes, False)


@pytest.mark.slow
def test_the_command_leaves_numbers_page_strips_and_recordings(tmp_path, capsys):
    out, recordings = tmp_path / 'results', tmp_path / 'recordings'
    words = ['evaluate', 'planning', '--tasks', 'push2', '--methods', 'nothing', 'direct',
             'shipped:carried', '--scenes', '2', '--jobs', '2', '--step-budget', '2', '--out',
             str(out), '--recordings', str(recordings), '--plan-samples', '8',
             '--plan-iterations', '1']
    assert main(words) == 0
    rows = json.loads((out / 'planning.json').read_text())
    assert {row['method'] for row in rows} == {
        'nothing', 'direct:steps2', 'shipped:carried:steps2'}
    carried = [row for row in rows if row['method'] == 'shipped:carried:steps2']
    assert {row['step_budget'] for row in carried} == {2}
    assert {row['tracking'] for row in carried} == {'carried'}
    assert 'tracking_error_px' in {row['metric'] for row in carried}
    assert '--methods shipped:carried:steps2 --scenes 2' in carried[0]['command']
    page = (out / 'planning.md').read_text()
    assert 'planning/push2-direct--steps2.png' in page
    assert '**direct:steps2**, the best, the median and the worst of 2 scenes: ' in page
    assert (out / 'planning' / 'push2-direct--steps2.png').read_bytes().startswith(b'\x89PNG')
    recorded = recordings / 'push2-shipped--carried--steps2.mcap'
    assert len(list(iter_episodes(recorded))) == 3
    before = recorded.stat().st_mtime_ns
    assert main(words) == 0 and recorded.stat().st_mtime_ns == before  # nothing is run again
    assert main([*words, '--results-only']) == 0
    assert (out / 'planning.md').read_text().count('![') == 2
    assert main([*words, '--methods', 'unheard_of']) == 1
    assert '--predictor unheard_of=FILE' in capsys.readouterr().err
