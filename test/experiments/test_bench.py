# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks measure what they say."""

from experiments.bench import recording
import pytest


def test_all_frames_are_opened_beside_another_job(monkeypatch):
    monkeypatch.setattr(recording, 'JPEG_FRAMES', 20)
    args = recording.Options(episodes=2, files=1, repeats=1)
    *ours, pictures = recording.measure(args)
    assert [row.ratio > 0 for row in ours] == [True, True]
    assert '20 JPEG frames' in pictures.what and pictures.reached
    monkeypatch.setattr(recording, '_build_cache', lambda paths, scratch: 1)
    with pytest.raises(RuntimeError, match='saw 1 of'):
        recording.measure(args)
