# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of decoding measures what it says."""

from experiments.bench import recording
import pytest
from tap_ros.cli import main


def test_all_contenders_see_all_frames():
    results = recording.measure(episodes=5, files=2, repeats=1, image_size=16)
    assert set(results) == {'none', 'zstd'}
    for speeds in results.values():
        assert {'mcap + rosbags CDR, images only', 'tap_ros cache, new'} <= set(speeds)
        assert all(min(speed) > 0 for speed in speeds.values())


def test_the_table_has_a_line_for_each_contender(capsys):
    assert main(['bench', 'recording', '--episodes', '2', '--files', '1', '--repeats', '1']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ['raw', 'zstd', 'raw', 'zstd']
    names = [line[:44].strip() for line in lines[2:]]
    assert 'tap_ros cache, new' in names and 'ours / mcap + rosbags CDR, images only' in names
    assert all(float(n.replace(',', '')) > 0 for line in lines[2:] for n in line[44:].split())


def test_a_contender_that_skips_frames_is_caught(monkeypatch):
    monkeypatch.setattr(recording, '_build_cache', lambda paths, scratch: 1)
    with pytest.raises(RuntimeError, match='saw 1 of'):
        recording.measure(episodes=1, files=1, repeats=1, image_size=8)
