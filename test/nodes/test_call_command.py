# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m tap_ros call` asks a real node."""

import re

import cv2
from lively import lively_network
import numpy as np
from processes import LocalNode
import pytest
from tap_ros.cli import main
from tap_ros.nodes.predictor.node import PredictorNode
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.training.weights import save_weights

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def weights(tmp_path_factory):
    """Return the weights that a running node in the namespace /asked has."""
    folder = tmp_path_factory.mktemp('asked')
    network = lively_network()
    save_weights(folder / 'a.safetensors', network, 'predictor', network.config, {})
    node = LocalNode(PredictorNode, '/asked', weights=folder / 'a.safetensors')
    yield folder / 'a.safetensors'
    node.end()


def test_it_prints_places_and_draws_what_the_node_answers(weights, tmp_path, capsys):
    start, goal = np.random.default_rng(3).integers(0, 256, (2, 32, 32, 3), np.uint8)
    out, start_file, goal_file = (
        str(tmp_path / f'{name}.png') for name in ('answer', 'start', 'goal'))
    cv2.imwrite(start_file, start[..., ::-1])
    cv2.imwrite(goal_file, goal[..., ::-1])
    assert main(['call', '--namespace', '/asked', '--start', start_file, '--goal', goal_file,
                 '--objects', '8,9', '20,21', '--goal-objects', '12,13', '24,17',
                 '--out', out]) == 0
    said = capsys.readouterr().out
    subgoal, = SubgoalPredictor.load(weights).predict(
        start, goal, np.array([(8, 9), (20, 21)]), np.array([(12, 13), (24, 17)]))
    found = np.array(re.findall(r'object \d at ([\d.-]+),([\d.-]+)', said), float)
    assert found == pytest.approx(subgoal.expected_pixels, abs=0.06)
    assert 'bidirectional, 1 subgoal, maps of object 1, object 2' in said
    assert len(said) < 400, 'a summary, no pixels'
    picture = cv2.imread(out)
    assert picture.shape[1] > 1.5 * picture.shape[0] and picture.std() > 20


def test_a_refusal_says_why_and_writes_nothing(weights, tmp_path, capsys):
    out = tmp_path / 'answer.png'
    assert main(['call', '--namespace', '/asked', '--out', str(out)]) == 1
    assert 'nothing has come on /asked/camera/image_raw (no node publishes it)' in (
        capsys.readouterr().err)
    assert not out.exists()


def test_what_cannot_be_asked_is_named(capsys):
    for words, reason in (
            (['--namespace', '/nobody', '--timeout', '0.5'], '/nobody/predict_subgoal'),
            (['--objects', '3,4'], '--objects'), (['--samples', '-1'], 'num_samples'),
            (['--out', 'a.txt'], '.png'), (['--start', 'nowhere.png'], 'nowhere.png')):
        assert main(['call', *words]) == 1
        error = capsys.readouterr().err
        assert reason in error and error.count('\n') == 1
