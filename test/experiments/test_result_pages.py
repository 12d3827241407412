# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pages in docs/results are what the code makes of the data beside them."""

import json
from pathlib import Path

from experiments.bench.engine import make_page as make_engine_page
from experiments.paper.page import make_page as make_prediction_page
from experiments.paper.results import load_runs, on_same_episodes, told_apart
from experiments.paper.rows import as_frame, group_runs, make_rows

RESULTS = Path(__file__).parents[2] / 'docs' / 'results'


def text_of(name):
    return (RESULTS / name).read_text()


def rows_of(name):
    return json.loads(text_of(name))


def test_numbers_of_predictions_are_made_from_the_scores():
    runs, left_out = on_same_episodes(load_runs(RESULTS / 'runs'))
    assert not left_out
    # One task: all take ten times as long.
    made = told_apart(make_rows(group_runs([run for run in runs if run['task'] == 'pick_place'])))
    published = [row for row in rows_of('prediction.json') if row['task'] == 'pick_place']
    assert made == published and len(made) > 50


def test_the_page_about_predictions_is_made_from_the_numbers():
    runs, left_out = on_same_episodes(load_runs(RESULTS / 'runs'))
    rows = as_frame([{**row, 'metric': row['metric'].removesuffix('_warp_only')}
                     for row in rows_of('prediction.json')])
    pictures = sorted(path.name for path in RESULTS.glob('*.png'))
    assert make_prediction_page(rows, runs, left_out, ['small'], pictures,
                                text_of('findings.md')) == text_of('README.md')


def test_the_page_about_engines_is_made_from_the_numbers():
    def without_machine(page):
        return [line for line in page.splitlines() if 'cores (' not in line]

    page = make_engine_page(rows_of('engine.json'))
    assert without_machine(page) == without_machine(text_of('engine.md'))
