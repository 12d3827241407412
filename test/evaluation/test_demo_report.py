# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the demo's page and table."""

import numpy as np
import pytest
from tap_ros.evaluation.demo_report import results_table, Run, SceneRuns, write_report


@pytest.fixture
def scenes():
    rng = np.random.default_rng(0)

    def picture():
        return rng.integers(0, 255, (16, 16, 3), np.uint8)

    def run(end):
        return Run([picture() for _ in range(4)], np.linspace(0.2, end, 4)[:, None].repeat(2, 1),
                   'ended <early> & well', 500.0)
    maps = np.zeros((2, 16, 16))
    maps[:, 4, 5] = 1
    return [SceneRuns(seed, picture(), picture(), np.ones((2, 2)), np.full((2, 2), 9.0), picture(),
                      maps, {'direct': run(0.11), 'subgoal': run(0.05)}) for seed in (7, 8)]


def test_the_table_shows_centimetres_and_their_mean(scenes):
    lines = results_table(scenes).splitlines()
    assert lines[2].split() == ['scene', '7', '20.0', '11.0', '5.0']
    assert lines[-1].split() == ['mean', 'of', '2', '20.0', '11.0', '5.0']


def test_the_page_is_one_file_with_everything_inside(scenes, tmp_path):
    path = tmp_path / 'report.html'
    write_report(path, scenes, 'made by a test')
    page = path.read_text()
    assert page.count('<h2>Scene') == 2
    assert page.count('data:image/png;base64,') == page.count('<img ')
    assert 'http' not in page and '<early>' not in page and '&lt;early&gt; &amp;' in page
