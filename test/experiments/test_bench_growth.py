# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of growth: what it measures, and what its page says."""

import json
from pathlib import Path

import cv2
from experiments.bench import growth
import numpy as np
import pytest

RESULTS = Path(__file__).parents[2] / 'docs' / 'results'
ROWS = [{'part': 'samples', 'size': size, 'work': 'plan', 'ms': ms}
        for size, ms in ((64, 200.0), (128, 300.0))] + [
            {'part': 'sizes', 'size': 64, 'work': 'draw a picture', 'ms': 2.5}]


@pytest.mark.slow
def test_objects_and_pictures_that_grow_are_measured():
    args = growth.Options(objects=(1, 4), repeats=1)
    rows = list(growth._objects(args))
    assert [(row['size'], row['work']) for row in rows] == [
        (1, 'plan'), (1, 'predict'), (4, 'plan'), (4, 'predict')]
    assert all(row['ms'] > 0 for row in rows)


def test_the_page_tells_each_time_beside_that_of_the_least_work():
    page = growth.make_page(ROWS)
    assert '| samples | 64 | plan | 200.0 ms | 1.00 |' in page
    assert '| samples | 128 | plan | 300.0 ms | 1.50 |' in page
    assert '| sizes | 64 | draw a picture | 2.5 ms | 1.00 |' in page
    picture = cv2.imdecode(np.frombuffer(growth.draw(ROWS), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 2 * picture.shape[0], 'a panel for each of two parts'


@pytest.mark.slow
def test_decoding_is_measured_where_nothing_was_decoded_before(tmp_path, monkeypatch):
    monkeypatch.setenv('TAP_ROS_CACHE', str(tmp_path / 'cache'))
    rows = list(growth._episodes(growth.Options(episodes=(2,))))
    assert [row['work'] for row in rows] == ['collect', 'decode into the cache', 'open again']
    assert all(row['ms'] > 0 for row in rows)
    assert not (tmp_path / 'cache').exists(), "the user's cache may have these episodes"


def test_the_page_and_its_numbers_are_of_the_same_measurement():
    rows = json.loads((RESULTS / growth.ROWS).read_text())
    assert {row['part'] for row in rows} == set(growth.AXES)
    table = (RESULTS / growth.PAGE).read_text()
    assert str(growth.make_page(rows)).split('| grows')[1] == table.split('| grows')[1]
