# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo in a world of others, and laws of its page, table and film."""

import base64
from dataclasses import replace
import io
import re

import numpy as np
from PIL import Image, ImageSequence
import pytest
from tap_ros.nodes.demo import command
from tap_ros.nodes.demo.report import (
    FRAME_MS,
    GAP,
    HEIGHT,
    HOLD_MS,
    results_table,
    Run,
    SceneRuns,
    SMALL,
    write_film,
    write_report,
)
from tap_ros.recording.cache import open_recordings


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
    return [SceneRuns(
        'push2', seed, picture(), picture(), np.ones((2, 2)), np.full((2, 2), 9.0), picture(),
        maps, {'direct': run(0.11), 'subgoal': run(0.05)}) for seed in (7, 8)]


def test_the_page_is_one_file_with_everything_inside(scenes, tmp_path):
    side = [np.full((24, 32, 3), grey, np.uint8) for grey in (0, 80, 160, 240)]
    scenes[1].runs['direct'] = replace(scenes[1].runs['direct'], side=side)
    scenes.append(replace(scenes[0], task='grasp', runs={}, expert=side))  # nothing was planned
    path = tmp_path / 'report.html'
    assert results_table(scenes[:2]).splitlines()[2].split() == [
        'push2', '7', '20.0', '11.0', '5.0']
    write_report(path, scenes, 'made by a test', {'command': 'a <b>', 'date': 'today'})
    page = path.read_text()
    assert '<dt>command</dt><dd>a &lt;b&gt;</dd><dt>date</dt><dd>today</dd>' in page
    rows = re.findall(r'<tr class="(\w*)"><th scope="row">(.*?)</th>(.*?)</tr>', page)
    assert [(kind, label, re.findall('<td>(.*?)</td>', cells)) for kind, label, cells in rows] == [
        ('', 'push2 7', ['20.0', '11.0', '5.0']), ('', 'push2 8', ['20.0', '11.0', '5.0']),
        ('mean', 'push2, mean of 2', ['20.0', '11.0', '5.0'])]
    assert re.findall('<h2>(.*)</h2>', page) == ['push2 7', 'push2 8', 'grasp 7']
    assert page.count('src="data:image/') == page.count('<img ')
    assert 'http' not in page and '<early>' not in page and '&lt;early&gt; &amp;' in page
    films = re.findall('data:image/webp;base64,([^"]*)"', page)
    assert len(films) == 2
    for data in films:
        film = Image.open(io.BytesIO(base64.b64decode(data)))
        greys = [np.asarray(frame.convert('L'), int).mean()
                 for frame in ImageSequence.Iterator(film)]
        assert np.abs(np.subtract(greys, [0, 80, 160, 240])).max() < 8


def test_the_film_shows_each_run_to_its_end_and_stops_there(scenes, tmp_path):
    path = tmp_path / 'demo.webp'
    greys = {'direct': (0, 60, 120, 180), 'subgoal': (240, 90)}  # one run is shorter
    for scene in scenes:
        for mode, run in scene.runs.items():
            pictures = [np.full((16, 32, 3), grey, np.uint8) for grey in greys[mode]]
            scene.runs[mode] = replace(run, side=pictures)
    write_film(path, scenes)
    film, shown, milliseconds = Image.open(path), [], 0
    centres = [SMALL + GAP + i * (2 * HEIGHT + GAP) + HEIGHT for i in (0, 1)]
    for frame in ImageSequence.Iterator(film):
        pixels = np.array(frame.convert('L'), int)[-4]  # a row that no mark reaches
        shown.append(tuple(pixels[centres]))
        milliseconds += frame.info['duration']
    expected = [(0, 240), (60, 90), (120, 90), (180, 90)] * len(scenes)
    assert np.abs(np.subtract(shown, expected)).max() <= 6
    assert milliseconds == len(scenes) * (3 * FRAME_MS + HOLD_MS)
    assert film.info['loop'] == 0  # for ever


@pytest.mark.slow
def test_real_nodes_push_in_a_world_of_others_that_says_how_it_ended(tmp_path, capsys):
    pytest.importorskip('metaworld')
    folder = tmp_path / 'demo'
    assert command.run(command.Options(
        scenes=1, tasks=('push-v3',), world='metaworld', robot_mask='arm', step_budget=1,
        out=str(folder))) == 0
    said = capsys.readouterr().out
    assert re.search(r'direct .* in 1 steps.*\n    subgoal .* in 1 steps', said)
    assert (folder / 'demo.webp').stat().st_size and (folder / 'report.html').stat().st_size
    episodes = list(open_recordings(folder / 'recording' / 'push-v3'))[-2:]
    assert [(len(one), one.task, one.outcome) for one in episodes] == [
        (2, 'push-v3', 'failure')] * 2
    for one in episodes:
        moved = one.grippers[1, :3] - one.grippers[0, :3]
        np.testing.assert_allclose(moved, one.actions[0, :3], atol=0.02)
