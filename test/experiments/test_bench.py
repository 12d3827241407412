# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks measure what they say."""

from pathlib import Path

from experiments.bench import recording
import pytest
from tap_ros.cli import main

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
