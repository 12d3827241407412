# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the list of runs."""

from dataclasses import asdict, replace
import json
from pathlib import Path

from experiments.paper.runs import (
    FINE_TUNED,
    paper_runs,
    PaperRun,
    PAST_VARIANTS,
    SCALES,
)
from tap_ros.prediction.methods import method_fields, todays_settings
from tap_ros.prediction.training_config import DEFAULTS
from tap_ros.training.settings import FREE

ROOT = Path(__file__).parents[2]

EVERY = [run for scale in SCALES for run in paper_runs(scale)]
MAIN = {'fix-wo-gan', 'min-wo-gan', 'genmin-wo-gan', 'genmin-wo-gan+progress'}


def test_every_run_can_be_trained_as_its_name_says():
    for run in EVERY:
        config = run.config('bags', 'runs/paper')
        assert method_fields(config.method) == method_fields(run.method)
        assert config.mode == run.mode
        assert config.seed == run.seed
        assert config.goal_picture == ('mixed' if run.task in FINE_TUNED else 'last')
        assert config.outer_power == 1
        assert config.recordings == (f'bags/{run.task}',)
        assert config.out == f'runs/paper/{run.scale}/{run.name}'
        assert config.skips == (config.decoder == 'shared') == ('+skips' in run.variant)
        if 'progress' not in run.method and 'margin' not in run.variant:
            assert config.margin == 0


def test_names_are_unique_and_the_first_seed_comes_first():
    for scale in SCALES:
        runs = paper_runs(scale, seeds=(0, 1))
        assert len({run.name for run in runs}) == len(runs)
        assert runs[:len(runs) // 2] == paper_runs(scale, seeds=(0,))
        usual = paper_runs(scale)
        assert sorted(run.seed for run in usual) == [run.seed for run in usual]
        assert usual[:len(runs) // 2] == paper_runs(scale, seeds=(0,))
        assert {run.seed for run in usual} == {0, 1, 2}


def test_finished_runs_have_the_settings_of_today():
    runs = {(run.scale, run.name): run for run in EVERY}
    files = sorted(ROOT.glob('docs/results/runs/*/*.json'))
    assert files
    for path in files:
        if any(past in path.stem for past in PAST_VARIANTS):
            continue
        stored = {**DEFAULTS, **todays_settings(json.loads(path.read_text())['config'])}
        config = asdict(runs[path.parent.name, path.stem].config('bags', 'runs'))
        for name in {**stored, **config}.keys() - {*FREE, 'precision'}:
            assert stored[name] == config[name], (path.stem, name)


def test_the_command_says_what_was_set():
    run = replace(paper_runs('small', episodes=40)[0], seed=2, steps=7)
    assert run.command == ('python -m tap_ros paper --scale small --only '
                           'push2-bidirectional-genmin-wo-gan+relative+skips-warp-s2 --seeds 2 '
                           '--episodes 40 --steps 7')
    assert PaperRun(**json.loads(json.dumps(vars(run)))) == run
