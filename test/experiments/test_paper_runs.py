# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the list of runs."""

from dataclasses import asdict, replace
import json

from experiments.paper.runs import paper_runs, PaperRun, SCALES
import pytest
from sim_bridge.tasks import TASKS
from tap_ros.errors import ConfigError

EVERY = [run for scale in SCALES for run in paper_runs(scale, seeds=(0, 1))]


def rows(task, mode, new_pixels):
    return {run.method for run in paper_runs('small') if run.recursion == 1 and (
        run.task, run.mode, run.new_pixels, run.variant) == (task, mode, new_pixels, '')}


@pytest.mark.parametrize('task', ['grasp', 'pick_place', 'push2'])
def test_table_1_is_complete(task):
    assert {'fix', 'min', 'genmin', 'genmin-wo-gan', 'genmin-vae-gan'} <= rows(
        task, 'bidirectional', True)


def test_fig_4_and_the_bottleneck_figure_are_complete():
    assert rows('grasp', 'forward', True) == {
        'fix0.25', 'fix0.50', 'fix0.75', 'fix1.00', 'min', 'genmin0.5', 'genmin2', 'genmin4',
        'genmin7', 'genmin10', 'genmin30'}
    assert {'fix', 'genmin', 'genmin+relative'} <= rows('push2', 'bidirectional', False)


def test_every_run_can_be_trained_as_its_name_says():
    for run in EVERY:
        config = run.config('bags', 'runs/paper')
        assert config.chosen.name == run.method and config.mode == run.mode
        assert config.seed == run.seed
        assert (config.goal_picture == 'last') == (run.variant != '+mixed')
        tasks = ('push2', 'push3') if run.task == 'push3' else (run.task,)
        assert run.task in TASKS and config.recordings == tuple(f'bags/{t}' for t in tasks)
        assert config.out == f'runs/paper/{run.scale}/{run.name}'
        if 'relative' not in run.method and not run.variant:
            assert (config.margin, config.outer_power) == (0, 1)


def test_names_are_unique_and_the_first_seed_comes_first():
    for scale in SCALES:
        runs = paper_runs(scale, seeds=(0, 1))
        assert len({run.name for run in runs}) == len(runs)
        assert runs[:len(runs) // 2] == paper_runs(scale)
        assert runs[0].name == 'push2-bidirectional-genmin+relative-warp-s0'


def test_rows_of_a_task_and_mode_differ_in_the_method_only():
    free = {'method', 'out', 'new_pixels', 'recursion', 'margin', 'outer_power', 'goal_picture',
            'kl_weight', 'initial_weights'}  # and what +changed changes, for all rows with it
    for scale in SCALES:
        settings = {}
        for run in paper_runs(scale):
            values = {name: value for name, value in asdict(run.config('b', 'r')).items()
                      if name not in free}
            assert settings.setdefault(
                (run.task, run.mode, run.variant == '+changed'), values) == values


def test_the_command_of_three_objects_makes_what_it_begins_with():
    run = PaperRun('push3', 'bidirectional', 'fix', new_pixels=False)
    assert run.before in paper_runs('small')
    assert f'--only {run.before.name} {run.name}' in run.command


def test_three_objects_are_trained_on_two_as_well_and_longer():
    run = PaperRun('push3', 'bidirectional', 'fix', new_pixels=False)
    assert run.config('bags', 'r').recordings == ('bags/push2', 'bags/push3')
    assert run.num_steps == 3600 and replace(run, steps=7).num_steps == 7
    full = replace(run, scale='full')
    assert full.num_steps * 64 == 200 * 2 * 55000


def test_full_has_the_papers_length():
    run = PaperRun('grasp', 'bidirectional', 'genmin', scale='full')
    config = run.config('bags', 'runs')
    assert config.steps * config.batch_size == 200 * 50000
    assert config.pretrain_steps * config.batch_size == pytest.approx(10 * 50000, rel=1e-3)
    assert replace(run, episodes=3200).config('bags', 'runs').steps == 200 * 50


def test_the_command_says_what_was_set():
    run = replace(paper_runs('small', episodes=40)[0], seed=2, steps=7)
    assert run.command == ('python -m tap_ros paper --scale small --only '
                           'push2-bidirectional-genmin+relative-warp-s2 --seeds 2 --episodes 40 '
                           '--steps 7')
    assert PaperRun(**json.loads(json.dumps(vars(run)))) == run


def test_an_unknown_scale_is_refused():
    with pytest.raises(ConfigError, match='small, full'):
        paper_runs('huge')
