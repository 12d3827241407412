# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes publish the model cards of the weights that they have loaded."""

from lively import lively_network
from processes import NodeProcess
import pytest
from std_msgs.msg import String
from tap_ros.nodes.clients import Newest
from tap_ros.nodes.topics import LATCHED
from tap_ros.training.weights import save_weights, stored_digest
from tap_ros.weights import FORWARD_MODEL, PREDICTORS


@pytest.fixture
def card(client, tmp_path):
    """Start a node and return what it says of its weights."""
    started = []

    def start(name, **parameters):
        started.append(NodeProcess(name, tmp_path / f'{name}.log', parameters))
        started[-1].wait_for('ready')
        return Newest(client, String, f'{name}/model_card', LATCHED).wait(20).data

    yield start
    for process in started:
        process.kill()


def test_cards_of_both_weights_of_the_predictor_and_what_tells_the_files(card, tmp_path):
    mine, network = tmp_path / 'mine.safetensors', lively_network(num_context=1)
    save_weights(mine, network, 'predictor', network.config, {})
    text = card('predictor_node', weights='pick_place_vae', forward_weights=mine)
    shipped = PREDICTORS['pick_place_vae']
    assert text.startswith(shipped.with_suffix('.md').read_text().rstrip())
    assert '# mine.safetensors' in text and 'No model card' in text
    assert stored_digest(shipped) in text and stored_digest(mine) in text
    assert str(tmp_path) not in text


def test_the_card_of_the_planner_s_forward_model(card):
    text = card('visual_mpc_node')
    assert text.startswith(FORWARD_MODEL.with_suffix('.md').read_text().rstrip())
    assert stored_digest(FORWARD_MODEL) in text
