# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of weights files, and what is said about files that are none."""

import json

import pytest
from safetensors.torch import save_file
from tap_ros.errors import WeightsError
from tap_ros.prediction.networks import Predictor, PredictorConfig
from tap_ros.prediction.weights import load_into, load_weights, make_config, save_weights
import torch

CONFIG = PredictorConfig(base_width=4, new_pixels=False)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / 'folder' / 'weights.safetensors'
    save_weights(path, Predictor(CONFIG).to(memory_format=torch.channels_last), 'predictor',
                 CONFIG, {'seed': 3})
    return path


def test_weights_round_trip(path):
    network = Predictor(CONFIG)
    save_weights(path, network, 'predictor', CONFIG, {'seed': 3, 'scores': {'min_l1': 0.5}})
    values, state, training = load_weights(path, 'predictor')
    assert make_config(PredictorConfig, values, path) == CONFIG
    assert training == {'seed': 3, 'scores': {'min_l1': 0.5}}
    other = Predictor(CONFIG)
    load_into(other, state, path)
    for name, tensor in network.state_dict().items():
        assert other.state_dict()[name].equal(tensor), name


def test_nothing_else_is_left_in_the_folder(path):
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_failed_writing_leaves_the_old_file(path):
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save_weights(path, Predictor(CONFIG), 'predictor', CONFIG, {'unstorable': object()})
    assert path.read_bytes() == before
    assert len(list(path.parent.iterdir())) == 1


def test_missing_file(tmp_path):
    with pytest.raises(WeightsError, match=r'none\.safetensors: no such.*train'):
        load_weights(tmp_path / 'none.safetensors', 'predictor')


@pytest.mark.parametrize('size', [0, 5, 100, 5000, -1])
def test_truncated_file(path, size):
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(WeightsError, match='weights.safetensors: damaged, truncated'):
        load_weights(path, 'predictor')


def test_wrong_kind(path):
    with pytest.raises(WeightsError, match='of a predictor, not of a forward_model'):
        load_weights(path, 'forward_model')


def test_somebody_elses_safetensors(tmp_path):
    save_file({'weight': torch.zeros(2)}, tmp_path / 'other.safetensors')
    with pytest.raises(WeightsError, match='other.safetensors: written by format None'):
        load_weights(tmp_path / 'other.safetensors', 'predictor')


def test_unknown_configuration(path):
    with pytest.raises(WeightsError, match='unknown configuration wings; known are base_width'):
        make_config(PredictorConfig, {'wings': 2}, path)


def test_wrong_size(path):
    _, state, _ = load_weights(path, 'predictor')
    with pytest.raises(WeightsError, match='encoder.0.weight has size'):
        load_into(Predictor(PredictorConfig(base_width=8, new_pixels=False)), state, path)
    with pytest.raises(WeightsError, match='missing.*pixel_decoder'):
        load_into(Predictor(PredictorConfig(base_width=4)), state, path)


def test_a_pickle_is_not_loaded(tmp_path):
    torch.save({'weight': torch.zeros(2)}, tmp_path / 'pickle.safetensors')
    with pytest.raises(WeightsError, match='damaged'):
        load_weights(tmp_path / 'pickle.safetensors', 'predictor')


def test_configuration_is_readable_json(path):
    header = path.read_bytes()
    length = int.from_bytes(header[:8], 'little')
    about = json.loads(json.loads(header[8:8 + length])['__metadata__']['about'])
    assert about['kind'] == 'predictor' and about['config']['base_width'] == 4
