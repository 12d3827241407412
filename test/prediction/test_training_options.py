# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each option of a training does what it says."""

from dataclasses import replace
import json

import numpy as np
import pytest
from tap_ros.prediction import training
from tap_ros.prediction.batches import make_batch, Sampling
from tap_ros.prediction.methods import method_fields
from tap_ros.prediction.predictor import load_network
from tap_ros.prediction.training_config import TrainingConfig
from tap_ros.recording.cache import open_recordings
from tap_ros.training.checkpoints import start
from tap_ros.training.devices import Processes
from tap_ros.training.frames import MappedFrames
from tap_ros.training.weights import load_tensors
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch

STILL = {'learning_rate': 1e-12, 'discriminator_rate': 1e-12}  # weights stay what they begin with
HEAD = 'network.head.0.weight'


@pytest.fixture
def config(bag, tmp_path):
    return TrainingConfig(
        recordings=(str(bag),), out=str(tmp_path / 'run'), base_width=4, batch_size=4, steps=1,
        warmup=0, margin=1, test_fraction=0.3, threads=1, precision='float32', log_every=1,
        average_decay=0.0, new_pixels=True, selection='relative', start_crop=0.0,
        decoder='separate', skips=False)


@pytest.fixture
def trained(config, tmp_path):
    """Train with some options; return the checkpoint's tensors."""
    def run(stop_at=None, **options):
        run.count += 1
        run.config = replace(config, **{'out': str(tmp_path / f'run{run.count}'), **options})
        run.path = training.train(run.config, stop_at=stop_at, progress=False)
        return load_tensors(f'{run.config.out}/checkpoint.safetensors')[0]
    run.count = 0
    return run


def curve(folder, name):
    return [(point.step, point.value) for point in
            EventAccumulator(folder).Reload().Scalars(f'train/{name}')]


def moments(tensors, optimizer):
    """Return all first moments of an Adam in one vector."""
    return torch.cat([value.flatten() for name, value in sorted(tensors.items())
                      if name.startswith(f'optimizer.{optimizer}.') and 'exp_avg' in name
                      and 'exp_avg_sq' not in name])


@pytest.mark.parametrize('clip', [0.0, 0.01, 1e6])
def test_the_gradient_is_clipped_to_the_norm_given(trained, clip):
    tensors = trained(gradient_clip=clip)
    (_, norm), = curve(trained.config.out, 'gradient_norm')
    used = moments(tensors, 0).norm().item() / (1 - 0.9)  # Adam's first step
    assert norm > 0.02
    assert used == pytest.approx(min(norm, clip or norm), rel=1e-3)


@pytest.mark.parametrize('warmup', [0, 4])
def test_both_learning_rates_are_those_of_the_schedule(trained, warmup):
    options = {**method_fields('genmin'), 'steps': 5, 'warmup': warmup, 'stop_at': 1}
    before = trained(**options | STILL)
    tensors = trained(**options, learning_rate=3e-3, discriminator_rate=5e-4)
    for name, rate in (('network.head', 3e-3), ('helpers.discriminator', 5e-4)):
        name = next(key for key in tensors if key.startswith(name) and key.endswith('weight'))
        moved = (tensors[name] - before[name]).abs()
        # Adam's first step has the length of the rate, whatever the gradient.
        assert moved.max().item() == pytest.approx(rate / (warmup + 1), rel=0.02), name


def test_adam_remembers_less_where_networks_are_trained_against_each_other():
    def betas(**helpers):
        state = start(torch.nn.Linear(1, 1), 1e-3, 'cpu', helpers)
        return [optimizer.param_groups[0]['betas'] for optimizer in state.optimizers]
    assert betas() == betas(recognition=torch.nn.Linear(1, 1)) == [(0.9, 0.999)]
    assert betas(discriminator=torch.nn.Linear(1, 1)) == [(0.5, 0.999)] * 2


@pytest.mark.parametrize('step, decay, stays', [
    (0, 0.999, 0.1), (8, 0.999, 0.5), (10**6, 0.9, 0.9), (0, 0.0, 0.0)])
def test_the_average_moves_fast_at_first(step, decay, stays):
    state = start(torch.nn.Linear(3, 2), 1e-3, 'cpu')
    before = state.average.weight.clone()
    with torch.no_grad():
        state.network.weight += 1.0
    state.step = step
    state.update_average(decay)
    assert torch.allclose(state.average.weight, before + (1 - stays), atol=1e-6)


def test_the_average_is_shipped_and_its_decay_is_the_one_given(trained):
    tensors = trained(steps=3, average_decay=0.9)
    assert not tensors[HEAD].equal(tensors[HEAD.replace('network', 'average')])
    shipped = dict(load_network(trained.path)[0].named_parameters())
    assert shipped['head.0.weight'].equal(tensors[HEAD.replace('network', 'average')])
    tensors = trained(steps=3, average_decay=0.0)
    assert tensors[HEAD].equal(tensors[HEAD.replace('network', 'average')])


@pytest.mark.parametrize('values', [
    {'base_width': 8}, {'new_pixels': False},
    {'latent': 'vae', 'latent_size': 5}, {'mode': 'forward'}, {'decoder': 'shared'},
    {'decoder': 'shared', 'skips': True}])
def test_the_network_is_the_one_asked_for(trained, values):
    trained(**values)
    shape = load_network(trained.path)[0].config
    assert (shape.base_width, shape.new_pixels) == (
        values.get('base_width', 4), values.get('new_pixels', True))
    assert shape.latent_size == values.get('latent_size', 0)
    assert shape.num_context == (1 if 'mode' in values else 2)
    assert (shape.decoder, shape.skips) == (
        values.get('decoder', 'separate'), values.get('skips', False))


@pytest.mark.parametrize('posterior, method, images', [
    ('video', 'genmin-vae', 5), ('frame', 'genmin-vae', 3)])
def test_z_is_inferred_from_as_many_pictures_as_asked_for(trained, posterior, method, images):
    tensors = trained(**method_fields(method), posterior=posterior, video_frames=5, num_targets=2)
    first = next(value for name, value in sorted(tensors.items())
                 if name.startswith('helpers.recognition.encoder') and value.ndim == 4)
    assert first.shape[1] == 3 * images


@pytest.mark.parametrize('fraction', [0.0, 0.2, 0.5])
def test_so_many_episodes_are_held_out(trained, fraction):
    trained(test_fraction=fraction)
    with open(f'{trained.config.out}/run.json') as file:
        run = json.load(file)
    assert run['episodes'] + run['held_out'] == 24
    assert abs(run['held_out'] - 24 * fraction) <= 4  # by a hash of each seed
    assert (run['held_out'] == 0) == (fraction == 0)


def test_curves_have_a_point_every_so_many_steps(trained):
    trained(steps=6, log_every=3)
    assert [step for step, _ in curve(trained.config.out, 'loss')] == [3, 6]


def test_a_checkpoint_is_written_every_so_many_steps(trained, monkeypatch):
    steps, save = [], training.save_checkpoint

    def note(path, state, *args):
        steps.append(state.step)
        save(path, state, *args)
    monkeypatch.setattr(training, 'save_checkpoint', note)
    trained(steps=5, save_every=2)
    assert steps == [2, 4, 5]


def test_the_precision_is_the_one_given(trained):
    exact, again, half = (trained(precision=name)[HEAD]
                          for name in ('float32', 'float32', 'bfloat16'))
    assert exact.equal(again) and not exact.equal(half)


def test_so_many_threads_are_used(trained):
    before = torch.get_num_threads()
    try:
        for count in (1, 2):
            trained(threads=count)
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize('option, method, term, factor', [
    ('gan_weight', 'genmin', 'gan', 10.0), ('kl_weight', 'genmin-vae', 'kl', 10.0)])
def test_terms_of_the_loss_have_their_weights(trained, option, method, term, factor):
    values = []
    for weight in (1e-3, 1e-3 * factor):
        trained(**method_fields(method), **{option: weight}, **STILL)
        (_, value), = curve(trained.config.out, f'loss_{term}')
        (_, error), = curve(trained.config.out, 'loss_error')
        (_, loss), = curve(trained.config.out, 'loss')
        assert loss == pytest.approx(error + value, rel=1e-5)
        values.append(value)
    assert values[1] == pytest.approx(factor * values[0], rel=1e-3)


def test_z_costs_nothing_at_first_and_has_the_spread_asked_for(trained):
    found = {}
    for name, options in (('usual', {}), ('rising', {'kl_warmup': 0.5}),
                          ('narrow', {'posterior_std': 0.1})):
        trained(**method_fields('genmin-vae'), **options, **STILL)
        found[name] = [dict(curve(trained.config.out, part))[1] for part in ('loss_kl', 'nats')]
    assert found['usual'][0] > 0 and found['rising'][0] == 0
    assert found['rising'][1] == pytest.approx(found['usual'][1])
    # of each of the 32 numbers of z: (0.01 - 1 - log 0.01) / 2
    assert found['narrow'][1] - found['usual'][1] == pytest.approx(32 * 1.81, rel=0.05)


def losses(trained, **options):
    trained(**options)
    return dict(curve(trained.config.out, 'loss'))[1]


def test_each_setting_of_the_objective_reaches_the_loss(trained):
    plain = losses(trained, **method_fields('genmin-wo-gan'))
    assert losses(trained, **method_fields('genmin-wo-gan')) == plain
    for options in ({'outer_power': 0.5}, {'recursion': 2}, {'loss': 'min'}, {'loss': 'fix'},
                    {'loss': 'fix', 'fraction': 0.2}, {'selection': 'relative'}):
        changed = losses(trained, **{**method_fields('genmin-wo-gan'), **options})
        assert changed != pytest.approx(plain, rel=1e-6), options


# What is taken from the episodes


@pytest.fixture(scope='module')
def store(bag, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('TAP_ROS_CACHE', str(tmp_path_factory.mktemp('cache')))
        yield open_recordings([str(bag)], progress=False)


@pytest.fixture
def drawn(config, store, monkeypatch):
    """Return (Batch, Augmentation, Sampling) of some steps of a training with some options."""
    def draw(steps=6, **options):
        settings, used = replace(config, steps=steps, **{
            'batch_size': 8, 'goal_picture': 'last', **options}), []

        def make(store, chosen, sampling, *others):
            used.append(sampling)
            return make_batch(store, chosen, sampling, *others)

        monkeypatch.setattr(training, 'make_batch', make)
        found = [(batch, augmentation) for _, batch, augmentation in training._batches(
            store, MappedFrames(store), None, np.arange(len(store.lengths)), settings,
            Processes(0, 1), 0, steps)]
        return [(*each, sampling) for each, sampling in zip(found, used, strict=True)]
    return draw


def test_what_is_taken_from_episodes_is_what_the_settings_say(drawn):
    same = {'margin': 2, 'num_targets': 3, 'min_crop': 0.7, 'start_crop': 0.2,
            'goal_picture': 'mixed', 'fill_context': 0.4}
    options = {**same, 'robot_mask': 'all', 'batch_size': 5}
    batch, _, sampling = drawn(2, **options)[0]
    assert sampling == Sampling(**same) and len(batch.context) == 5
    assert drawn(2, **options, mode='forward', video_frames=7, latent='vae', loss='fix',
                 fraction=0.3, gan=True)[0][2] == Sampling(
        **same, forward=True, video_frames=7, fraction=0.3, num_others=1)
    assert drawn(2, latent='vae', posterior='frame')[0][2].video_frames == 0


def test_pictures_change_as_asked_for_and_not_at_all_without(drawn):
    def looks(**options):
        augmentations = [augmentation for _, augmentation, _ in drawn(20, **options)]
        return (torch.cat([a.flip for a in augmentations]).float().mean().item(),
                torch.cat([a.order for a in augmentations]).unique(dim=0).tolist(),
                (torch.cat([a.gain for a in augmentations]) - 1).abs().max().item())
    off = {'flip': False, 'colour': False, 'brightness': 0.0}
    assert looks(**off) == (0.0, [[0, 1, 2]], 0.0)
    assert 0.3 < looks(**off | {'flip': True})[0] < 0.7
    assert len(looks(**off | {'colour': True})[1]) == 6
    assert 0.25 < looks(**off | {'brightness': 0.3})[2] <= 0.3
