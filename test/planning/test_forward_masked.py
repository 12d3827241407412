# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A forward model for pictures without the robot: what a mask hides teaches it nothing."""

from dataclasses import replace
import json

from made_episodes import cover, write_bag
import numpy as np
import pytest
from tap_ros.errors import ConfigError
from tap_ros.planning.forward_loss import forward_loss, make_windows
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
from tap_ros.planning.forward_scores import map_errors
from tap_ros.planning.forward_training import train
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
from tap_ros.planning.table import fit_arm, fit_shift, project
from tap_ros.recording.cache import open_recordings
from tap_ros.training.inpainted import FilledStore
from tap_ros.training.robot_mask import fill_from_past, trained_robot_mask
from tap_ros.training.split import split_episodes
from tap_ros.training.weights import load_tensors
import torch
from toy_world import ARM, make_episode, SIZE, TABLE

HOMOGRAPHY = torch.tensor(TABLE).view(3, 3)


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Write the same episodes twice, with robots that look different."""
    folder = tmp_path_factory.mktemp('covered')
    return [write_bag(folder / f'robot{seed}', [
        cover(make_episode(i), side=9, seed=seed) for i in range(30)]) for seed in range(2)]


def windows(bag, robot_mask, mirrored):
    """Return windows of the third frame on, first pictures filled as FreeView does."""
    store = FilledStore(open_recordings([bag], progress=False), robot_mask,
                        filling=fill_from_past)
    return make_windows(store, [0, 1], [2, 3], 4, HOMOGRAPHY, np.array([mirrored] * 2), [1, 2],
                        robot_mask)


def learn(batch, robot_mask='all'):
    """Return the loss and all gradients of an untrained model."""
    torch.manual_seed(0)
    model = LearnedForwardModel(ForwardModelConfig(
        TABLE, ARM, image_size=SIZE, width=16, robot_mask=robot_mask))
    loss, _ = forward_loss(model, batch, {1, 3, 4}, ForwardTrainingConfig(('x',), 'x'))
    loss.backward()
    return [loss.detach(), *(p.grad for p in model.parameters() if p.grad is not None)]


@pytest.mark.parametrize('mirrored', [False, True])
def test_a_masked_robot_leaves_no_trace_in_loss_and_gradients(bags, mirrored):
    first, second = (windows(bag, 'all', mirrored) for bag in bags)
    assert torch.equal(first.hidden, second.hidden) and first.hidden.any()
    second.images[:, 0] = first.images[:, 0]  # where nothing was seen yet the robot shows
    assert not torch.equal(first.images, second.images)
    for mine, others in zip(learn(first), learn(second)):
        assert torch.equal(mine, others)
    second.hidden[:] = False
    assert not torch.equal(learn(first)[0], learn(second)[0])


def test_masks_are_mirrored_with_their_pictures(bags):
    plain, flipped = (windows(bags[0], 'all', mirrored) for mirrored in (False, True))
    assert torch.equal(flipped.hidden, plain.hidden.flip(-1))
    assert not torch.equal(flipped.hidden, plain.hidden)
    assert not windows(bags[0], 'none', False).hidden.any()


def test_without_the_robot_no_arm_is_drawn():
    for robot_mask in ('none', 'arm', 'all'):
        model = LearnedForwardModel(ForwardModelConfig(
            TABLE, ARM, image_size=SIZE, width=16, robot_mask=robot_mask))
        assert bool(model.draw_arm(torch.zeros(1, 4)).any()) is (robot_mask != 'all')
    with pytest.raises(ConfigError, match='robot_mask'):
        ForwardModelConfig(TABLE, ARM, robot_mask='hand')
    with pytest.raises(ConfigError, match='robot_mask'):
        ForwardTrainingConfig(('x',), 'x', robot_mask='hand')


def test_weights_tell_and_score_what_they_were_trained_with(bags, tmp_path):
    config = ForwardTrainingConfig(
        recordings=(str(bags[0]),), out=str(tmp_path / 'a'), steps=1, batch_size=2, horizon=3,
        pictures=2, width=16, features=4, test_fraction=0.2, device='cpu', threads=1,
        robot_mask='all')
    path = train(config, progress=False)
    assert trained_robot_mask(load_tensors(path)[1]['training']) == ('all', 1.0)
    model = LearnedForwardModel.load(path, precision='float32')
    assert model.config.robot_mask == 'all'
    store = open_recordings([bags[0]], progress=False)
    filled = FilledStore(store, 'all', filling=fill_from_past)
    _, held_out = split_episodes(store, config.test_fraction, config.horizon + 1)
    told = json.loads((tmp_path / 'a' / 'scores.json').read_text())
    assert map_errors(model, filled, held_out) == pytest.approx(told)


def test_the_hand_is_found_by_its_mask(bags):
    store = open_recordings([bags[0]], progress=False)
    episodes = [store[i] for i in range(30)]
    rng = np.random.default_rng(0)
    moved = []
    for episode in episodes:
        grippers = np.zeros_like(episode.grippers)
        grippers[:, :3] = rng.uniform(-0.3, 0.3, (len(grippers), 3))
        masks = np.zeros_like(episode.robot_masks)
        camera = torch.tensor(ARM).view(3, 4)
        for mask, (u, v) in zip(masks, project(camera, torch.tensor(grippers[:, :3])).numpy()):
            mask[round(float(v)) - 1:round(float(v)) + 2,
                 round(float(u)) - 1:round(float(u)) + 2] = 128
            mask[0, 0] = 255
        moved.append(replace(episode, grippers=grippers, robot_masks=masks))
    fitted = torch.from_numpy(fit_arm(moved)).float()
    points = torch.tensor(rng.uniform(-0.3, 0.3, (20, 3))).float()
    np.testing.assert_allclose(
        project(fitted, points), project(torch.tensor(ARM).view(3, 4), points), atol=0.3)


def test_a_camera_that_was_moved_is_found_by_its_objects():
    episode = make_episode(4)
    moved = replace(episode, object_pixels=episode.object_pixels + np.float32([1.5, -2]))
    table = fit_shift(moved, np.array(TABLE).reshape(3, 3))
    places = torch.from_numpy(episode.object_poses[:, 0, :2])
    np.testing.assert_allclose(
        project(torch.from_numpy(table), places), moved.object_pixels[:, 0], atol=1e-4)
    unknown = replace(episode, object_pixels=episode.object_pixels * np.float32(np.nan))
    np.testing.assert_array_equal(
        fit_shift(unknown, np.array(TABLE).reshape(3, 3)), np.array(TABLE).reshape(3, 3))
