# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of training the predictor; each option does what it says."""

from dataclasses import replace
import json
from pathlib import Path

from experiments.paper.methods import method_fields
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.recording.cache import open_recordings
from tap_ros.training.batches import Pictures, Sampling
from tap_ros.training.predictor import (
    draw_batch,
    kl_share,
    sampling_of,
    train,
    VIDEO_FRAMES,
)
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights.weights import load_tensors, load_weights
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch

HEAD = 'network.head.0.weight'


@pytest.fixture
def config(bag, tmp_path):
    return TrainingConfig(
        recordings=(str(bag),), out=str(tmp_path / 'run'), base_width=4, batch_size=4, steps=4,
        margin=1, test_fraction=0.3, threads=1, save_every=2, log_every=2,
        precision='float32', selection='relative')


@pytest.fixture
def store(bag):
    return open_recordings([str(bag)], progress=False)


def weights(config):
    return load_tensors(f'{config.out}/checkpoint.safetensors')[0]


def curve(folder, name):
    return {point.step: point.value for point in
            EventAccumulator(folder).Reload().Scalars(f'train/{name}')}


@pytest.mark.parametrize('values', [
    {**method_fields('genmin-vae-gan'), 'kl_warmup': 0.5, 'posterior_std': 0.1,
     'num_targets': 3, 'min_crop': 0.6},
    {**method_fields('genmin4'), 'mode': 'forward', 'recursion': 2, 'decoder': 'separate',
     'skips': False}])
def test_two_steps_and_two_more_equal_four(config, tmp_path, values):
    config = replace(config, **values)
    train(config, progress=False)
    interrupted = replace(config, out=str(tmp_path / 'interrupted'))
    train(interrupted, stop_at=2, progress=False)
    halfway = weights(interrupted)
    train(interrupted, progress=False)
    expected, resumed = weights(config), weights(interrupted)
    assert set(expected) == set(resumed)
    assert all(resumed[name].equal(tensor) for name, tensor in expected.items())
    assert not halfway[HEAD].equal(resumed[HEAD])


def test_a_training_learns(config):
    config = replace(config, selection='progress', steps=20, learning_rate=1e-2, new_pixels=True,
                     save_every=20, log_every=20)
    losses = []
    for stop in (1, 20):
        train(config, stop_at=stop, progress=False)
        losses.append(json.loads(Path(config.out, 'scores.json').read_text())['loss'])
    assert losses[1] < losses[0]


def test_a_training_can_begin_with_the_weights_of_another(config, tmp_path, capsys):
    first = train(config, stop_at=1, progress=False)
    tuned = replace(config, out=str(tmp_path / 'tuned'), initial_weights=first, seed=1,
                    learning_rate=1e-12, steps=2)
    begun = dict(load_network(train(tuned, stop_at=1, progress=False))[0].named_parameters())
    for name, tensor in load_network(first)[0].named_parameters():
        assert torch.allclose(begun[name], tensor, atol=1e-6), name
    other = replace(config, out=str(tmp_path / 'other'), initial_weights=first, base_width=8)
    with pytest.raises(ConfigError, match='base_width 4 instead of 8'):
        train(other, progress=False)
    assert not (Path(other.out) / 'checkpoint.safetensors').exists()
    # A recipe takes their shape and size; what is asked for beside it is refused as above.
    few = ['train', 'predictor', *config.recordings, '--initial-weights', first, '--steps', '1',
           '--batch-size', '2', '--recipe', 'stack2', '--threads', '1', '--test-fraction', '0']
    assert main([*few, '--out', str(tmp_path / 'few')]) == 0
    shape = load_network(tmp_path / 'few' / 'predictor.safetensors')[0].config
    assert shape == load_network(first)[0].config
    assert main([*few, '--new-pixels', '--out', str(tmp_path / 'wrong')]) == 1
    assert 'new_pixels False instead of True' in capsys.readouterr().err
    Path(first).unlink()  # once begun, it goes on without them
    train(tuned, progress=False)


def test_a_run_leaves_what_is_needed_to_repeat_it(config):
    path = train(config, progress=False)
    about = {name: json.loads(Path(config.out, f'{name}.json').read_text())
             for name in ('config', 'run', 'scores')}
    assert about['run']['steps'] == 4 and len(about['run']['data_hash']) == 64
    assert about['run']['episodes'] + about['run']['held_out'] == 24
    _, shipped, told = load_weights(path, 'predictor')
    assert (told['scores'], told['settings']) == (about['scores'], about['config'])
    assert SubgoalPredictor.load(path).image_size == (32, 32)
    tensors = weights(config)  # the average is shipped
    assert all(tensors[f'average.{name}'].equal(tensor) for name, tensor in shipped.items())
    assert not tensors[HEAD].equal(shipped['head.0.weight'])
    assert set(curve(config.out, 'loss')) == set(curve(config.out, 'learning_rate')) == {2, 4}
    assert {event.step for event in EventAccumulator(config.out).Reload().Images('held_out')} == {
        2, 4}


def test_the_price_of_z_rises():
    shares = [kl_share(step, 100, 0.4) for step in range(100)]
    assert shares[:41] == [0] * 41 and shares[60] == 0.5 and shares[80:] == [1] * 20
    assert kl_share(0, 100, 0.0) == 1


def test_settings_that_make_no_sense_or_do_nothing_are_refused_by_name(config):
    for values in (
            {'recordings': ()}, {'loss': 'max'}, {'steps': 0},
            {'selection': 'progress', 'mode': 'forward'},
            {'recursion': 2, 'loss': 'fix'}, {'posterior': 'frame', 'latent': 'vae', 'gan': True},
            {'posterior': 'frame'}, {'posterior': 'frame', 'free_nats': 1.0, 'latent': 'vae'},
            {'free_nats': 1.0}, {'robot_mask': 'hand'}, {'fill_context': 0.5}):
        with pytest.raises(ConfigError, match=next(iter(values))):
            TrainingConfig(**{'recordings': ('bag',), **values}).check()
    with pytest.raises(ConfigError, match="device: 'nonsense'"):
        train(replace(config, device='nonsense'), progress=False)


def test_what_is_taken_from_episodes_is_what_the_settings_say(config, store):
    def drawn(**options):
        settings = replace(config, **{'goal_picture': 'last', 'margin': 0, 'start_crop': 0.0,
                                      **options})
        return draw_batch(store, np.arange(len(store)), settings, Pictures(), 0)

    same = {'margin': 2, 'num_targets': 3, 'min_crop': 0.7, 'start_crop': 0.2,
            'goal_picture': 'mixed', 'fill_context': 0.4}
    config = replace(config, **same, robot_mask='all')
    assert sampling_of(config) == Sampling(**same)
    config = replace(config, mode='forward', latent='vae', loss='fix', fraction=0.3, gan=True)
    assert sampling_of(config) == Sampling(
        **same, forward=True, video_frames=VIDEO_FRAMES, fraction=0.3, num_others=1)
    assert sampling_of(replace(config, posterior='frame')).video_frames == 0
    assert len(drawn(batch_size=5).context) == 5
    off = drawn(colour=False, brightness=0.0).augmentation
    assert len(off.order.unique(dim=0)) == 1 and off.gain.eq(1).all()
    on = drawn(colour=True, brightness=0.3, batch_size=24).augmentation
    assert on.flip.any() and not on.flip.all()
    assert len(on.order.unique(dim=0)) == 6 and 0.2 < (on.gain - 1).max() <= 0.3
