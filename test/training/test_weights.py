# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of weights files, and what is said about files that are none."""

import json
import os

import numpy as np
import pytest
from safetensors.torch import save_file
from tap_ros.base.errors import WeightsError
from tap_ros.planning.forward_model import LearnedForwardModel
from tap_ros.prediction.networks import PredictorConfig, PredictorNetwork
from tap_ros.prediction.predictor import load_network
from tap_ros.weights import FORWARD_MODEL
from tap_ros.weights.weights import (
    load_tensors,
    load_weights,
    make_network,
    save_tensors,
    save_weights,
)
import torch

CONFIG = PredictorConfig(base_width=4, image_size=16, new_pixels=False)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / 'folder' / 'weights.safetensors'
    save_weights(path, PredictorNetwork(CONFIG).to(memory_format=torch.channels_last), 'predictor',
                 CONFIG, {'seed': 3})
    return path


def test_weights_round_trip_and_fit_their_configuration(path):
    network = PredictorNetwork(CONFIG)
    save_weights(path, network, 'predictor', CONFIG, {'seed': 3, 'scores': {'min_l1': 0.5}})
    values, state, training = load_weights(path, 'predictor')
    assert training == {'seed': 3, 'scores': {'min_l1': 0.5}}
    other = make_network(PredictorNetwork, PredictorConfig, values, state, path)
    assert other.config == CONFIG
    assert all(other.state_dict()[name].equal(tensor)
               for name, tensor in network.state_dict().items())
    for config, said in (
            (values | {'base_width': 8}, 'size mismatch for encoder.0.weight'),
            ({k: v for k, v in values.items() if k != 'code_size'}, 'configuration code_size'),
            (values | {'wings\n': 2}, 'unknown configuration wings')):
        with pytest.raises(WeightsError, match=said):
            make_network(PredictorNetwork, PredictorConfig, config, state, path)


def test_files_that_are_no_weights_are_refused_with_the_reason(path, tmp_path):
    with pytest.raises(WeightsError, match='of a predictor, not of a forward_model'):
        load_weights(path, 'forward_model')
    whole, (tensors, about) = path.read_bytes(), load_tensors(path)
    for size in (0, 5, 100, 5000, -1):
        path.write_bytes(whole[:size])
        assert 'damaged, truncated' in refusal(load_network, path)
    torch.save({'weight': torch.zeros(2)}, path)  # a pickle
    assert 'safetensors file' in refusal(load_network, path)
    for metadata, said in (
            (None, 'written by format None'),
            ({'format': 'tap_ros 1', 'about': json.dumps(about)}, 'format tap_ros 1, not by'),
            ({'format': 'tap_ros 2', 'about': json.dumps(about)}, 'train again')):
        save_file(tensors, path, metadata)
        assert said in refusal(load_network, path)
    for header in (b'[]', b'{"__metadata__": 3} ', b' ' * 2 ** 23, b'[' * 2 ** 20):
        path.write_bytes(len(header).to_bytes(8, 'little') + header)
        refusal(load_network, path)
    (tmp_path / 'memory').symlink_to('/proc/self/mem')  # whoever reads it, it cannot be
    assert 'no such' in refusal(load_network, tmp_path / 'none.safetensors')
    refusal(load_network, tmp_path / 'memory')


def refusal(load, *arguments):
    """Return what is said; it is one line that names the file."""
    with pytest.raises(WeightsError) as error:
        load(*arguments)
    text = str(error.value)
    assert text.isprintable() and str(arguments[0]) in text
    return text


def test_any_flip_of_a_bit_is_refused(path):
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    header = 8 + int.from_bytes(whole[:8], 'little')
    places = [*range(8), *rng.integers(8, header, 200), *rng.integers(header, len(whole), 200)]
    for place in map(int, places):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        refusal(load_network, path)
    path.write_bytes(whole)
    load_network(path)


def test_weights_that_are_zero_or_not_finite_are_refused(tmp_path):
    tensors, about = load_tensors(FORWARD_MODEL)
    for factor, said in ((0.0, 'zero'), (torch.nan, 'not finite')):
        save_tensors(tmp_path / 'w', {
            name: factor * tensor for name, tensor in tensors.items()}, about)
        assert said in refusal(LearnedForwardModel.load, tmp_path / 'w')


def test_configurations_that_cannot_be_are_refused_in_one_line(path, tmp_path):
    for file, load, wrong in (
            (path, load_network, {
                'flow_scale': '16', 'base_width': 4.0, 'image_size': 2 ** 30,
                'decoder': 'x' * 10 ** 6, 'skips': True}),
            (FORWARD_MODEL, LearnedForwardModel.load, {
                'table': [1.0] * 8, 'table_cells': 10 ** 6, 'crop_cells': [],
                'workspace_low': [0.0]})):
        tensors, about = load_tensors(file)
        for name, value in wrong.items():
            save_tensors(tmp_path / 'w', tensors, {
                **about, 'config': {**about['config'], name: value}})
            assert len(refusal(load, tmp_path / 'w')) < 700


def test_numbers_that_are_never_written_and_files_without_end_are_refused(path, tmp_path):
    tensors, about = load_tensors(path)
    name = next(iter(tensors))
    for kind in (torch.float8_e4m3fn, torch.complex64, torch.uint16):
        save_tensors(tmp_path / 'w', {**tensors, name: torch.zeros(3, 3).to(kind)}, about)
        assert str(kind) in refusal(load_network, tmp_path / 'w')
    (tmp_path / 'w').write_bytes(b'')
    os.truncate(tmp_path / 'w', 30 * 2**30)
    assert 'more than 4 GiB' in refusal(load_network, tmp_path / 'w')


def test_a_network_that_its_file_cannot_fill_is_not_made(path, tmp_path):
    tensors, about = load_tensors(path)
    save_tensors(tmp_path / 'w', tensors, {**about, 'config': {
        **about['config'], 'base_width': 2**11}})
    before = torch.get_rng_state()
    assert 'does not fit its own configuration' in refusal(load_network, tmp_path / 'w')
    assert torch.get_rng_state().equal(before)  # no weight was drawn
    network, _ = load_network(path)
    assert all(value.equal(tensors[name]) for name, value in network.state_dict().items())
