# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the demo's page, table and film."""

import base64
from dataclasses import replace
import io
import re

import numpy as np
from PIL import Image, ImageSequence
import pytest
from tap_ros.evaluation.demo_film import FRAMES_PER_S, GAP, HOLD, SCALE, write_film
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


def test_the_page_has_a_film_where_there_are_pictures_from_the_side(scenes, tmp_path):
    side = [np.full((24, 32, 3), grey, np.uint8) for grey in (0, 80, 160, 240)]
    scenes[1].runs['direct'] = replace(scenes[1].runs['direct'], side=side)
    path = tmp_path / 'report.html'
    write_report(path, scenes)
    films = re.findall('data:image/webp;base64,([^"]*)"', path.read_text())
    assert len(films) == 1
    film = Image.open(io.BytesIO(base64.b64decode(films[0])))
    greys = [np.asarray(frame.convert('L'), int).mean()
             for frame in ImageSequence.Iterator(film)]
    assert np.abs(np.subtract(greys, [0, 80, 160, 240])).max() < 8


def test_the_film_shows_each_run_to_its_end_and_stops_there(scenes, tmp_path):
    path, size = tmp_path / 'demo.gif', 16
    greys = {'direct': (0, 60, 120, 180), 'subgoal': (240, 90)}  # one run is shorter
    for scene in scenes:
        for mode, run in scene.runs.items():
            run.frames[:] = [np.full((size, size, 3), grey, np.uint8) for grey in greys[mode]]
    write_film(path, scenes)
    film, shown, seconds = Image.open(path), [], 0
    for frame in ImageSequence.Iterator(film):
        pixels = np.array(frame.convert('L'), int)[-GAP - 2]  # a row that no mark reaches
        centres = [i * (size * SCALE + GAP) + GAP + size * SCALE // 2 for i in (2, 3)]
        shown.append(tuple(pixels[centres]))
        seconds += frame.info['duration'] / 1000
    expected = [(0, 240), (60, 90), (120, 90), (180, 90)] * len(scenes)
    assert np.abs(np.subtract(shown, expected)).max() <= 2
    assert seconds == pytest.approx(len(scenes) * (4 + HOLD) / FRAMES_PER_S)
    assert film.info['loop'] == 0  # for ever
