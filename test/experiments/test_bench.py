# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks measure what they say."""

from pathlib import Path
import time

from experiments.bench import recording
from experiments.bench.training import time_step
import pytest
from tap_ros.cli import main
from tap_ros.prediction import training
from tap_ros.prediction.training_config import TrainingConfig

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'


def test_the_table_of_reading_has_a_line_for_each_contender(capsys, monkeypatch):
    assert main(['bench', 'recording', '--episodes', '2', '--files', '1', '--repeats', '1']) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line[:44].strip() for line in lines[2:]]
    assert 'tap_ros cache, new' in names and 'ours / mcap + rosbags CDR, images only' in names
    assert all(float(n.replace(',', '')) > 0 for line in lines[2:] for n in line[44:].split())
    monkeypatch.setattr(recording, '_build_cache', lambda paths, scratch: 1)
    with pytest.raises(RuntimeError, match='saw 1 of'):
        recording.measure(episodes=1, files=1, repeats=1, image_size=8)


def test_cpu_seconds_of_a_step_leave_out_what_waits(tmp_path, monkeypatch):
    step = training._step

    def slow(*args):
        time.sleep(0.5)
        return step(*args)

    monkeypatch.setattr(training, '_step', slow)
    cost = time_step(TrainingConfig(
        recordings=(str(SAMPLE),), out=str(tmp_path / 'run'), selection='absolute',
        base_width=4, batch_size=2, threads=1, device='cpu'), 1)
    assert 0 < cost.cpu_seconds < cost.seconds - 0.4
