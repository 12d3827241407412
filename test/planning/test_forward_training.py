# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the forward model's windows, augmentation, loss and training."""

from dataclasses import replace
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file
from tap_ros.errors import ConfigError
from tap_ros.planning.forward_data import augment_windows, COLOUR_ORDERS, read_windows
from tap_ros.planning.forward_loss import draw_arm_like, forward_loss, motion_weight
from tap_ros.planning.forward_scores import map_errors
from tap_ros.planning.forward_training import train
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
from tap_ros.planning.table import project
from tap_ros.recording.cache import open_recordings
import torch
from toy_world import make_episode, TABLE, to_pixels

HOMOGRAPHY = torch.tensor(TABLE).view(3, 3)


def windows(mirrored, order=0, seed=3, steps=4):
    store = [make_episode(seed)]
    raw = read_windows(store, [0], [2], steps)
    return augment_windows(*raw, HOMOGRAPHY, np.array([mirrored]), [order]), store[0]


def test_mirrored_windows_show_objects_where_the_mirrored_table_says():
    plain, episode = windows(False)
    flipped, _ = windows(True)
    torch.testing.assert_close(flipped.images, plain.images.flip(-1))
    square = torch.from_numpy(episode.object_poses[2, :1, :2]).float()
    pixels = project(flipped.homography[0], square * torch.tensor([-1.0, 1.0]))
    expected = torch.from_numpy(to_pixels(square.numpy()))
    expected[:, 0] = 31 - expected[:, 0]
    torch.testing.assert_close(pixels, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(flipped.actions[..., 0], -plain.actions[..., 0])
    torch.testing.assert_close(flipped.grippers[..., 1:], plain.grippers[..., 1:])


def test_recolouring_permutes_channels_only():
    plain, _ = windows(False)
    for i, order in enumerate(COLOUR_ORDERS):
        recoloured, _ = windows(False, i)
        torch.testing.assert_close(recoloured.images, plain.images[:, :, list(order)])


def test_arm_is_drawn_into_augmented_pictures_as_it_would_look(model):
    with torch.no_grad():
        model.sprite.copy_(torch.randn_like(model.sprite))
    plain, _ = windows(False)
    flipped, _ = windows(True, 4)
    arm = draw_arm_like(model, plain.grippers[:, 0], plain.mirrored, plain.colours)
    same = draw_arm_like(model, flipped.grippers[:, 0], flipped.mirrored, flipped.colours)
    expected = torch.cat([arm[:, list(COLOUR_ORDERS[4])], arm[:, 3:]], 1).flip(-1)
    torch.testing.assert_close(same, expected)


def test_motion_weight_marks_what_changed_and_its_neighbours():
    first = torch.zeros(1, 3, 16, 16)
    target = first.clone()
    target[:, :, 5, 5] = 1
    weight = motion_weight(target, first, 8.0)
    assert weight.sum() == 16 * 16 + 8 * 9 and weight[0, 0, 4, 6] == 9


def test_every_part_of_the_model_learns(model):
    batch, _ = windows(False)
    config = ForwardTrainingConfig(recordings=('x',), out='x')
    loss, parts = forward_loss(model.train(), batch, {2, 4}, config)
    loss.backward()
    still = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert not still and parts['picture'] > 0


def config_for(bag, out, **changes):
    config = ForwardTrainingConfig(
        recordings=(str(bag),), out=str(out), steps=4, batch_size=2, horizon=3, pictures=2,
        width=16, features=4, warmup=2, test_fraction=0.1, device='cpu', threads=1, save_every=2)
    return replace(config, **changes)


def test_resumed_training_equals_uninterrupted_training(bag, tmp_path):
    train(config_for(bag, tmp_path / 'a'), stop_at=2, progress=False)
    resumed = train(config_for(bag, tmp_path / 'a'), progress=False)
    whole = train(config_for(bag, tmp_path / 'b'), progress=False)
    first, second = load_file(resumed), load_file(whole)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
    run = json.loads((Path(tmp_path) / 'a' / 'run.json').read_text())
    assert run['steps'] == 4 and run['episodes'] + run['held_out'] == 60


@pytest.mark.parametrize('where', ['save_weights', 'save_checkpoint'])
def test_a_run_that_is_killed_while_it_saves_ends_as_it_would_have(
        bag, tmp_path, monkeypatch, where):
    def killed(*_):
        raise KeyboardInterrupt
    config = config_for(bag, tmp_path / 'a')
    train(config, stop_at=2, progress=False)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(f'tap_ros.planning.forward_training.{where}', killed)
        train(config, progress=False)
    resumed = load_file(train(config, progress=False))
    whole = load_file(train(config_for(bag, tmp_path / 'b'), progress=False))
    for name, value in whole.items():
        assert torch.equal(value, resumed[name]), name


def test_a_run_with_other_settings_is_not_resumed(bag, tmp_path):
    train(config_for(bag, tmp_path), stop_at=2, progress=False)
    with pytest.raises(ConfigError, match='learning_rate'):
        train(config_for(bag, tmp_path, learning_rate=1e-4), progress=False)


def test_untrained_model_scores_as_if_nothing_moved(bag, model):
    with torch.no_grad():
        model.push.masks.bias.copy_(torch.tensor([0.0, 0, 50]))  # says that all stays
    store = open_recordings([bag], progress=False)
    scores = map_errors(model, store, range(20), stride=2)
    for t in (5, 10, 15):
        assert scores[f'map_error_px_{t}'] == pytest.approx(
            scores[f'nothing_moves_px_{t}'], abs=0.05)


def test_training_on_one_window_learns_its_pictures(model):
    batch, _ = windows(False)
    config = ForwardTrainingConfig(recordings=('x',), out='x')
    optimizer = torch.optim.Adam(model.train().parameters(), 3e-3)
    losses = []
    for _ in range(60):
        loss, parts = forward_loss(model, batch, {1, 3, 4}, config)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(parts['picture'])
    assert losses[-1] < 0.3 * losses[0]


def test_impossible_settings_are_named():
    with pytest.raises(ConfigError, match='batch_size'):
        ForwardTrainingConfig(recordings=('x',), out='x', batch_size=0)
