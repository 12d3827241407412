# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of the forward model's windows, augmentation, loss and training."""

from dataclasses import asdict, replace
import json

import numpy as np
import pytest
from safetensors.torch import load_file
from tap_ros.errors import ConfigError, RecordingError
from tap_ros.planning.forward_loss import (
    COLOUR_ORDERS,
    draw_arm_like,
    draw_windows,
    forward_loss,
    make_windows,
    motion_weight,
    picture_loss,
)
from tap_ros.planning.forward_training import draw_step, model_config, train
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
from tap_ros.planning.table import project
from tap_ros.training.weights import load_tensors
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch
from toy_world import make_episode, TABLE, to_pixels

HOMOGRAPHY = torch.tensor(TABLE).view(3, 3)


def windows(mirrored, order=0, seed=3, steps=4):
    store = [make_episode(seed)]
    return make_windows(
        store, [0], [2], steps, HOMOGRAPHY, np.array([mirrored]), [order]), store[0]


def test_windows_without_the_gripper_are_refused_by_the_number_of_their_episode():
    store = [make_episode(seed) for seed in (1, 2, 3)]
    store[2].grippers[3, 0] = np.nan
    plain = HOMOGRAPHY, np.zeros(3, bool), [0] * 3
    assert len(make_windows(store, [0, 1, 2], [2, 2, 4], 4, *plain).images) == 3
    with pytest.raises(RecordingError, match='episode 2 lacks gripper positions'):
        make_windows(store, [0, 1, 2], [2, 2, 0], 4, *plain)


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


def test_differences_count_as_much_at_every_resolution():
    black = torch.zeros(2, 3, 16, 16)
    weight = torch.ones(2, 1, 16, 16)
    assert picture_loss(black, black + 0.25, weight) == pytest.approx(0.25)
    assert picture_loss(black, black + 0.25, 3 * weight) == pytest.approx(0.75)
    v, u = torch.meshgrid(torch.arange(16), torch.arange(16), indexing='ij')
    fine, coarse = (((u // n + v // n) % 2 * 2.0 - 1).expand(2, 3, -1, -1) for n in (1, 2))
    assert picture_loss(black, fine, weight) == pytest.approx(1 / 3)  # gone at half the size
    assert picture_loss(black, coarse, weight) == pytest.approx(2 / 3)  # gone at a quarter
    left = weight * (u < 8)
    assert picture_loss(black, black + (u >= 8), left) == 0


def test_the_loss_is_that_of_the_chosen_pictures_and_what_moves_costs_a_little(model):
    batch, _ = windows(False)
    config = ForwardTrainingConfig(
        recordings=('x',), out='x', still_weight=0.5, object_weight=0.25)
    losses = {steps: forward_loss(model, batch, set(steps), config)
              for steps in ((1,), (4,), (1, 4))}
    for loss, parts in losses.values():
        assert 0 < parts['moving'] < 1
        assert 0 < parts['objects'] < 1
        assert float(loss) == pytest.approx(
            parts['picture'] + 0.5 * parts['moving'] + 0.25 * parts['objects'])
    first, last, both = (parts for _, parts in losses.values())
    assert first['picture'] != last['picture'] and first['moving'] == last['moving']
    assert both['picture'] == pytest.approx((first['picture'] + last['picture']) / 2)
    with torch.no_grad():
        model.push.masks.bias.copy_(torch.tensor([0, 0, 50.0]))  # says that all stays
    assert forward_loss(model, batch, {1}, config)[1]['moving'] == pytest.approx(0, abs=1e-6)
    even = forward_loss(model, batch, {4}, replace(config, motion_factor=0.0))[1]['picture']
    assert even < last['picture']


class Store(list):
    """Episodes in memory, read like an EpisodeStore."""

    image_size = camera_size = (32, 32)

    @property
    def lengths(self):
        return [len(episode.frames) for episode in self]


def test_a_push_that_was_not_there_counts_as_much_as_one_that_was_missed(model):
    batch, _ = windows(False)
    batch.images[:, 1:] = batch.images[:, :1]  # nothing moves
    config = ForwardTrainingConfig(recordings=('x',), out='x', still_weight=0, object_weight=0)
    parts = [forward_loss(model, batch, {4}, replace(config, motion_factor=factor))[1]['picture']
             for factor in (0.0, 8.0)]
    assert parts[1] > 1.5 * parts[0]  # the untrained model moves what is there


def numbered(number, length):
    """Return an episode whose grippers say which episode and frame they are of."""
    episode = make_episode(number, length)
    grippers = np.stack([np.full(length, number), np.arange(length), *np.zeros((2, length))], 1)
    return replace(episode, grippers=grippers.astype(np.float32))


def test_windows_are_drawn_from_all_of_the_episodes_that_are_given():
    store = Store(numbered(number, length) for number, length in enumerate((9, 6, 5, 12)))
    batch = draw_windows(store, [1, 3], 400, 4, HOMOGRAPHY, np.random.default_rng(0), False)
    assert batch.images.shape == (400, 5, 3, 32, 32) and batch.actions.shape == (400, 4, 4)
    assert not batch.mirrored.any() and (batch.colours == torch.arange(3)).all()
    numbers, frames = batch.grippers[:, :, 0], batch.grippers[:, :, 1]
    assert (numbers == numbers[:, :1]).all() and (frames.diff(dim=1) == 1).all()
    starts = {(int(number), int(start)) for number, start in batch.grippers[:, 0, :2]}
    assert starts == {*((1, start) for start in range(2)), *((3, start) for start in range(8))}
    for i in range(20):
        episode, start = store[int(numbers[i, 0])], int(frames[i, 0])
        np.testing.assert_array_equal(batch.actions[i], episode.actions[start:start + 4])
    mixed = draw_windows(store, [0], 400, 4, HOMOGRAPHY, np.random.default_rng(0))
    assert 160 < mixed.mirrored.sum() < 240
    assert {tuple(order.tolist()) for order in mixed.colours} == set(COLOUR_ORDERS)


def test_a_step_draws_what_its_seed_and_number_say_and_windows_grow():
    store = Store(make_episode(number) for number in range(3))
    config = ForwardTrainingConfig(recordings=('x',), out='x', steps=100, grow=0.5, horizon=8,
                                   batch_size=3, pictures=4)

    def draw(step, **changes):
        return draw_step(replace(config, **changes), store, np.arange(3), step, HOMOGRAPHY)

    lengths = [draw(step)[0].actions.shape[1] for step in range(0, 100, 7)]
    assert lengths == sorted(lengths) and lengths[0] == 2 and set(lengths[8:]) == {8}
    assert draw(24)[0].actions.shape[1] == 5 and draw(48)[0].actions.shape[1] == 8
    assert draw(0, grow=0.0)[0].actions.shape[1] == 8
    assert draw(99, horizon=1)[0].actions.shape[1] == 1
    batch, shown = draw(60)
    same, same_shown = draw(60)
    assert torch.equal(batch.images, same.images) and shown == same_shown
    for other in (draw(61), draw(60, seed=1)):
        assert not torch.equal(batch.images, other[0].images)
    seen = [draw(60, seed=seed)[1] for seed in range(20)]
    assert all(len(each) == 4 for each in seen) and set().union(*seen) == set(range(1, 9))
    assert len(draw(0)[1]) == 2 and len(batch.images) == 3
    assert not draw(60, augment=False)[0].mirrored.any()


def test_the_network_fits_the_recordings():
    store = Store(make_episode(seed) for seed in range(40))
    config = ForwardTrainingConfig(recordings=('x',), out='x', width=16, features=5)
    made = model_config(config, store, np.arange(40))
    assert (made.image_size, made.width, made.features) == (32, 16, 5)
    np.testing.assert_allclose(np.array(made.table) / made.table[8], TABLE, atol=0.01)
    store.image_size = (32, 48)
    with pytest.raises(ConfigError, match='48x32'):
        model_config(config, store, np.arange(40))


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
        width=16, features=4, warmup=2, test_fraction=0.1, device='cpu', threads=1, save_every=2,
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
    run, config, scores = (json.loads((tmp_path / 'a' / f'{name}.json').read_text())
                           for name in ('run', 'config', 'scores'))
    assert run['steps'] == 4 and run['episodes'] + run['held_out'] == 60
    assert config == json.loads(json.dumps(asdict(config_for(bag, tmp_path / 'a'))))
    told = load_tensors(resumed)[1]['training']
    assert (told['settings'], told['scores'], told['steps']) == (config, scores, 4)
    curves = EventAccumulator(str(tmp_path / 'b')).Reload()
    assert {tag: [event.step for event in curves.Scalars(tag)]
            for tag in curves.Tags()['scalars']} == {
        **{f'train/{name}': [2, 4] for name in (
            'picture', 'moving', 'objects', 'gradient_norm', 'learning_rate')},
        **{f'held_out/{name}': [2, 4] for name in scores}}
    assert {tag: [event.step for event in curves.Images(tag)]
            for tag in curves.Tags()['images']} == {'training': [2, 4], 'held_out': [2, 4]}
    told = {tag: curves.Scalars(f'held_out/{tag}')[-1].value for tag in scores}
    assert told == pytest.approx(scores)
