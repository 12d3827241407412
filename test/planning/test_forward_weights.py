# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the shipped forward model is good for: recorded pushes."""

from dataclasses import replace
from itertools import islice
import json
from pathlib import Path

from made_episodes import write_bag
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.recording.cache import open_recordings
from tap_ros.training.forward_scores import held_out_scores
from tap_ros.weights import FORWARD_MODEL

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'


@pytest.fixture(scope='module')
def model():
    return LearnedForwardModel.load(FORWARD_MODEL, precision='float32')


def test_object_maps_are_carried_to_where_recorded_pushes_led(model):
    episodes = list(islice(open_recordings(SAMPLE), 6))
    scores = held_out_scores(model, episodes, range(len(episodes)))
    for t in (5, 10, 15):
        assert scores[f'map_error_px_{t}'] < 0.27 * scores[f'nothing_moves_px_{t}']
        assert scores[f'true_simulator_px_{t}'] < 0.02


def test_without_object_pixels_pictures_are_compared_with_copying(model, tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', [
        replace(episode, object_names=(), object_source='', **{
            name: getattr(episode, name)[..., :0, :] for name in (
                'object_pixels', 'object_poses', 'goal_pixels', 'goal_poses')})
        for episode in islice(open_recordings(SAMPLE), 6)])
    assert main(['evaluate', 'forward', '--recordings', str(bag), '--test-fraction', '1', '--out',
                 str(tmp_path)]) == 0
    assert 'better than copying' in capsys.readouterr().out
    told = held_out_scores(model, open_recordings([bag], progress=False), np.arange(6))
    rows = {(row['metric'], row['method'], row['step']): row
            for row in json.loads((tmp_path / 'forward_model.json').read_text())}
    assert len(rows) == 4 * 4 and {row['n'] for row in rows.values()} == {6}
    for (metric, method, step), row in rows.items():
        if method == 'forward_model':
            assert row['verdict'] == 'better than copying'
            assert row['value'] < 0.8 * rows[metric, 'copying', step]['value']
        if metric == 'changed_l1':
            assert told[f'changed_copying_l1_{step}'] > told[f'changed_picture_l1_{step}'] > 0
            assert row['value'] > 3 * rows['picture_l1', method, step]['value']
