# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of how well the place of the hand can be predicted."""

from dataclasses import replace
import json
from pathlib import Path
import subprocess
import sys

from experiments.paper.hand_place import (
    best_cover,
    bottleneck_hands,
    distance_to_nearest,
    FAR,
    known_places,
    measure,
    predict_places,
)
import numpy as np
import pytest
from tap_ros.errors import TapError
from tap_ros.recording.cache import open_recordings
import torch

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / 'bags' / 'sample_push2'


@pytest.fixture(scope='module')
def sample():
    return open_recordings(SAMPLE, progress=False)


def pushed(sample, homes, starts):
    """Return an episode of 6 frames: object k is at its start until starts[k], then moves."""
    poses = np.zeros((6, 2, 7))
    for k in (0, 1):
        poses[:, k, 1] = k
        poses[:, k, 0] = np.interp(np.arange(6), [starts[k], homes[k]], [0.0, 0.3])
    hands = np.zeros((6, 4), np.float32)
    hands[:, 0] = np.arange(6)
    episode = sample[0]
    return replace(
        episode, frames=episode.frames[:6], stamps=episode.stamps[:6], actions=episode.actions[:6],
        grippers=hands, object_pixels=episode.object_pixels[:6], object_poses=poses,
        robot_masks=None)


def test_a_bottleneck_is_one_object_home_and_the_other_untouched(sample):
    first, hands = bottleneck_hands(pushed(sample, homes=(5, 1), starts=(4, 0)))
    assert first == 1
    assert hands[:, 0].tolist() == [1, 2, 3, 4]


def test_objects_that_move_together_have_no_bottleneck(sample):
    assert bottleneck_hands(pushed(sample, homes=(4, 4), starts=(0, 0))) is None


def test_a_gripping_bottleneck_is_where_the_hand_closes_around_an_object_at_its_start(sample):
    episode = pushed(sample, homes=(5, 9), starts=(3, 8))
    actions = np.ones((6, 4), np.float32)
    actions[2:, 3] = 0
    first, hands = bottleneck_hands(replace(episode, task='stack2', actions=actions))
    assert first == 0
    assert hands[:, 0].tolist() == [2, 3]


def test_the_object_that_moves_first_stands_first(sample):
    episode = pushed(sample, homes=(5, 1), starts=(4, 0))
    assert known_places(episode, 1).tolist() == pytest.approx(
        [0, 1, 0, 0, 0.3, 1, 0.3, 0, 0, 0, 5, 0])


def test_the_nearest_frame_counts():
    hands = torch.tensor([[[0.0, 0.0], [0.3, 0.4], [FAR, FAR]]])
    assert distance_to_nearest(hands, torch.tensor([[0.3, 0.5]])).tolist() == pytest.approx([0.1])


def test_the_cover_is_of_both_sides_and_of_the_best_frame():
    hands = torch.tensor([[[0.0, 0.0], [0.3, 0.4], [FAR, FAR]], [[9.0, 9.0]] * 3])
    places = torch.tensor([[0.32, 0.39], [0.0, 0.0]])
    assert best_cover(hands, places, (0.04, 0.02)).tolist() == pytest.approx([0.75 * 0.75, 0])


def test_a_hand_that_follows_from_the_objects_is_found_and_a_random_one_is_not():
    rng = torch.Generator().manual_seed(0)
    known = torch.rand(800, 12, generator=rng) * 0.3
    other = torch.full((800, 3, 2), FAR)
    shares = []
    for hand in (known[:, 2:4] + known[:, 4:6], torch.rand(800, 2, generator=rng) * 0.3):
        hands = torch.cat([other, hand[:, None]], 1)
        places = predict_places(known[:700], hands[:700], known[700:])
        shares.append((distance_to_nearest(hands[700:], places) < 0.02).float().mean().item())
    assert shares[0] > 0.9
    assert shares[1] < 0.2


def test_episodes_without_a_task_are_refused(sample):
    class Unmarked:
        def __len__(self):
            return 3

        def __getitem__(self, i):
            return replace(sample[i], task='')

    with pytest.raises(TapError, match="tasks \\[''\\]"):
        measure(Unmarked(), 0.5)


@pytest.mark.parametrize('words, expected', [
    ([str(SAMPLE), '--held-out', '0.5'], 'expected at least 10 to train on and 10 to test on'),
    ([str(SAMPLE / 'nothing')], 'nothing'), ([], 'BAG')])
def test_what_cannot_be_measured_is_refused(tmp_path, words, expected):
    out = tmp_path / 'hands.json'
    out.write_text('{}')
    result = subprocess.run(
        [sys.executable, '-m', 'experiments.paper.hand_place', *words, '--out', str(out)],
        cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 1
    assert expected in result.stderr
    assert json.loads(out.read_text()) == {}
