# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the forward model's windows, loss and training, also with a robot that is masked."""

from dataclasses import replace

from made_bags import camera, mark, record
from made_episodes import cover, write_bag
import numpy as np
import pytest
from safetensors.torch import load_file
from tap_ros.base.errors import ConfigError, RecordingError
from tap_ros.images.robot_mask import fill_from_past
from tap_ros.planning.forward_model import ForwardModelConfig, LearnedForwardModel
from tap_ros.planning.table import project
from tap_ros.recording.cache import open_recordings
from tap_ros.training.forward import model_config, train
from tap_ros.training.forward_config import ForwardTrainingConfig
from tap_ros.training.forward_loss import (
    Cuts,
    forward_loss,
    make_windows,
    OBJECT_WEIGHT,
    STILL_WEIGHT,
)
from tap_ros.training.frames import FilledStore
from tap_ros.weights.weights import save_weights
import torch
from toy_world import ARM, make_episode, SIZE, TABLE, to_pixels

HOMOGRAPHY = torch.tensor(TABLE).view(3, 3)


def windows(mirrored, order=0, seed=3, steps=4):
    store = [make_episode(seed)]
    return make_windows(store, Cuts([0], [2], steps, mirrored, order), HOMOGRAPHY), store[0]


def test_windows_without_the_gripper_are_refused_by_the_number_of_their_episode():
    store = [make_episode(seed) for seed in (1, 2, 3)]
    store[2].grippers[3, 0] = np.nan
    assert len(make_windows(store, Cuts([0, 1, 2], [2, 2, 4], 4), HOMOGRAPHY).images) == 3
    with pytest.raises(RecordingError, match='episode 2 lacks gripper positions'):
        make_windows(store, Cuts([0, 1, 2], [2, 2, 0], 4), HOMOGRAPHY)


@pytest.mark.filterwarnings('ignore:recordings. only 0 episodes')
def test_recordings_without_commands_are_refused(tmp_path):
    bag = record(tmp_path / 'bag', [mark(1, 0), *map(camera, range(1, 13)), mark(13, 1)])
    with pytest.raises(RecordingError, match='hold no commands to the arm'):
        train(ForwardTrainingConfig(
            recordings=(str(bag),), out=str(tmp_path / 'run'), steps=1, size=16, crop='centre',
            test_fraction=0.0, threads=1), progress=False)


def test_mirrored_windows_show_objects_where_the_mirrored_table_says():
    (plain, episode), (flipped, _) = windows(False), windows(True)
    torch.testing.assert_close(flipped.images, plain.images.flip(-1))
    square = torch.from_numpy(episode.object_poses[2, :1, :2]).float()
    pixels = project(flipped.homography[0], square * torch.tensor([-1.0, 1.0]))
    expected = torch.from_numpy(to_pixels(square.numpy()))
    expected[:, 0] = 31 - expected[:, 0]
    torch.testing.assert_close(pixels, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(flipped.actions[..., 0], -plain.actions[..., 0])


def test_the_loss_is_that_of_the_chosen_pictures_and_what_moves_costs_a_little(
        model, monkeypatch):
    batch, _ = windows(False)
    forward_loss(model, batch, {2, 4})[0].backward()
    assert all(p.grad is not None and p.grad.any() for p in model.parameters())
    losses = {steps: forward_loss(model, batch, set(steps))
              for steps in ((1,), (4,), (1, 4))}
    for loss, parts in losses.values():
        assert 0 < parts['moving'] < 1
        assert 0 < parts['objects'] < 1
        assert float(loss) == pytest.approx(
            parts['picture'] + STILL_WEIGHT * parts['moving']
            + OBJECT_WEIGHT * parts['objects'])
    first, last, both = (parts for _, parts in losses.values())
    assert both['picture'] == pytest.approx((first['picture'] + last['picture']) / 2)
    with torch.no_grad():
        model.push.masks.bias.copy_(torch.tensor([0, 0, 50.0]))  # says that all stays
    assert forward_loss(model, batch, {1})[1]['moving'] == pytest.approx(0, abs=1e-6)
    monkeypatch.setattr('tap_ros.training.forward_loss.MOTION_FACTOR', 0.0)
    assert forward_loss(model, batch, {4})[1]['picture'] < last['picture']


def test_the_table_is_where_a_given_camera_sees_it_and_the_arm_must_be_where_it_says():
    store = Store(map(make_episode, range(8)))
    config = ForwardTrainingConfig(recordings=('x',), crop='4,2,24', size=16,
                                   projection=(*ARM[:2], 3.0, *ARM[3:]))
    made = model_config(config, store, np.arange(8))
    points = torch.tensor([[0.1, -0.2], [0.0, 0.1]], dtype=torch.float64)
    table = torch.tensor(made.table, dtype=torch.float64).view(3, 3)
    np.testing.assert_allclose(project(table, points), config.cut.pixels(project(
        HOMOGRAPHY.double(), points).numpy(), (32, 32)), atol=1e-6)
    for episode in store:
        episode.grippers[:] = np.random.default_rng(0).permutation(episode.grippers)
    with pytest.raises(RecordingError, match='px from where its gripper positions'):
        model_config(config, store, np.arange(8))
    with pytest.raises(ConfigError, match='projection: expected 12 numbers'):
        replace(config, projection=(1.0,)).check()


class Store(list):
    """Episodes in memory, read like an EpisodeStore."""

    image_size = camera_size = (32, 32)

    @property
    def lengths(self):
        return [len(episode.frames) for episode in self]


def config_for(bag, out, **changes):
    config = ForwardTrainingConfig(
        recordings=(str(bag),), out=str(out), steps=4, batch_size=2,
        test_fraction=0.1, device='cpu', threads=1, save_every=2,
        log_every=2)
    return replace(config, **changes)


def test_resumed_training_equals_uninterrupted_training(bag, tmp_path):
    train(config_for(bag, tmp_path / 'a'), stop_at=2, progress=False)
    resumed = train(config_for(bag, tmp_path / 'a'), progress=False)
    whole = train(config_for(bag, tmp_path / 'b'), progress=False)
    first, second = load_file(resumed), load_file(whole)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
    # Another training begins with these weights, but not with their picture of the arm.
    begins = {'steps': 1, 'learning_rate': 1e-9, 'initial_weights': resumed}
    begun = load_file(train(config_for(bag, tmp_path / 'c', **begins), progress=False))
    for name, value in first.items():
        assert torch.allclose(begun[name], value, atol=1e-6) == (name != 'sprite'), name
    narrow = ForwardModelConfig(TABLE, ARM, image_size=SIZE, width=8)
    save_weights(tmp_path / 'narrow', LearnedForwardModel(narrow), 'forward_model', narrow, {})
    with pytest.raises(ConfigError, match='for another network'):
        train(config_for(bag, tmp_path / 'd', **begins | {
            'initial_weights': str(tmp_path / 'narrow')}), progress=False)


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Write the same episodes twice, with robots that look different."""
    folder = tmp_path_factory.mktemp('covered')
    return [write_bag(folder / f'robot{seed}', [
        cover(make_episode(i), side=9, seed=seed) for i in range(20)]) for seed in range(2)]


def masked_windows(bag, robot_mask, mirrored):
    """Return windows of the third frame on, first pictures filled as FreeView does."""
    store = FilledStore(open_recordings([bag], progress=False), robot_mask,
                        filling=fill_from_past)
    return make_windows(store, Cuts([0, 1], [2, 3], 4, mirrored, np.array([1, 2])), HOMOGRAPHY,
                        robot_mask)


def learn(batch, robot_mask='all'):
    """Return the loss and all gradients of an untrained model."""
    torch.manual_seed(0)
    model = LearnedForwardModel(ForwardModelConfig(
        TABLE, ARM, image_size=SIZE, width=16, robot_mask=robot_mask))
    loss, _ = forward_loss(model, batch, {1, 3, 4})
    loss.backward()
    return [loss.detach(), *(p.grad for p in model.parameters() if p.grad is not None)]


def test_a_masked_robot_leaves_no_trace_in_loss_and_gradients(bags):
    first, second = (masked_windows(bag, 'all', True) for bag in bags)
    assert torch.equal(first.hidden, second.hidden) and first.hidden.any()
    second.images[:, 0] = first.images[:, 0]  # where nothing was seen yet the robot shows
    assert not torch.equal(first.images, second.images)
    for mine, others in zip(learn(first), learn(second)):
        assert torch.equal(mine, others)
    second.hidden[:] = False
    assert not torch.equal(learn(first)[0], learn(second)[0])
