# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the choice of a precision."""

from tap_ros.training import devices
from tap_ros.training.devices import bfloat16_gain, make_autocast, pick_precision
import torch

CPU = torch.device('cpu')


def test_half_precision_is_chosen_where_it_is_clearly_faster(monkeypatch):
    for gain, expected in ((0.0, 'float32'), (0.1, 'float32'), (1.0, 'float32'),
                           (1.5, 'bfloat16'), (6.0, 'bfloat16')):
        monkeypatch.setattr(devices, 'bfloat16_gain', lambda gain=gain: gain)
        assert pick_precision('auto', CPU) == expected
        assert pick_precision('float32', CPU) == 'float32'
        assert pick_precision('bfloat16', CPU) == 'bfloat16'
        assert pick_precision('auto', torch.device('cuda')) == 'bfloat16'


def test_the_trial_leaves_everything_as_it_was_and_is_made_once():
    bfloat16_gain.cache_clear()
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    found = bfloat16_gain()
    assert found > 0 and bfloat16_gain() == found
    assert torch.get_rng_state().equal(state) and torch.get_num_threads() == threads
    assert bfloat16_gain.cache_info().misses == 1


def test_what_torch_cannot_do_is_not_chosen(monkeypatch):
    def impossible(dtype):
        if dtype == torch.bfloat16:
            raise RuntimeError('not implemented for BFloat16')
        return 1.0
    monkeypatch.setattr(devices, '_pass_time', impossible)
    bfloat16_gain.cache_clear()
    try:
        assert pick_precision('auto', CPU) == 'float32'
    finally:
        bfloat16_gain.cache_clear()


def test_networks_run_in_what_was_chosen():
    for precision in ('float32', 'bfloat16'):
        with make_autocast(precision, CPU)():
            assert torch.nn.Linear(1, 1)(torch.ones(1, 1)).dtype == getattr(torch, precision)
