# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Few demonstrations: who is trained on, who stops a training and who is scored."""

from pathlib import Path

from experiments import few
import numpy as np
import pytest
from tap_ros.evaluation.prediction import EpisodeScores


def test_no_demonstration_is_scored_by_weights_that_have_seen_it(tmp_path, monkeypatch):
    for name in ('1', '2', '3', '10'):
        (tmp_path / 'clips' / name).mkdir(parents=True)
        (tmp_path / 'bags' / 'real' / name).mkdir(parents=True)
        (tmp_path / 'clips' / name / '0.mp4').touch()
    seen, scored = [], []

    def train(recordings, out, held_out, **settings):
        seen.append(({bag.name for bag in recordings}, {Path(bag).name for bag in held_out}))
        return out

    def score(weights, bags):
        scored.append((seen[-1], bags[0].name))
        ours, copied = np.array([0.1, 0.3]), np.array([0.2, 0.4])
        return None, EpisodeScores(ours, *[ours] * 7, copied, ours, copied)

    monkeypatch.setattr(few, 'train', train)
    monkeypatch.setattr(few, 'score', score)
    rows = few.real(few.Options(real=str(tmp_path / 'clips'), folds=3, cameras=('0',),
                                bags=str(tmp_path / 'bags')))
    assert [name for _, name in scored] == ['1', '10', '2', '3']
    for (recordings, stopping), name in scored:
        assert name not in recordings | stopping and stopping and stopping < recordings
    assert rows[0] == {'demonstration': '1', 'error': 0.2, 'copying': 0.3}
    assert few.relative(rows)[1].value == pytest.approx(2 / 3)
