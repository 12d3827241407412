# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the benchmark of training."""

from pathlib import Path
import time

from experiments.bench.training import time_step
import pytest
from tap_ros.prediction import training
from tap_ros.prediction.training_config import TrainingConfig
import torch

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'


@pytest.fixture
def config(tmp_path):
    return TrainingConfig(
        recordings=(str(SAMPLE),), out=str(tmp_path / 'run'), selection='absolute',
        base_width=4, batch_size=2, threads=1, device='cpu')


def test_the_time_of_a_step_leaves_out_what_surrounds_it(config, monkeypatch):
    def slow(*_):
        time.sleep(0.5)
        return torch.device('cpu')

    monkeypatch.setattr('tap_ros.prediction.training.pick_device', slow)
    began = time.monotonic()
    cost = time_step(config, 3)
    assert 0 < cost.seconds < (time.monotonic() - began - 0.5) / 3
    assert 0 < cost.cpu_seconds


def test_cpu_seconds_leave_out_what_waits(config, monkeypatch):
    step = training._step

    def slow(*args):
        time.sleep(0.5)
        return step(*args)

    monkeypatch.setattr(training, '_step', slow)
    cost = time_step(config, 1)
    assert cost.cpu_seconds < cost.seconds - 0.4
