# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of training the predictor."""

from dataclasses import replace
from functools import partial
import json
from pathlib import Path
import resource

import pytest
from tap_ros.cli import main
from tap_ros.errors import ConfigError, StorageError, WeightsError
from tap_ros.files import only_writer
from tap_ros.images.pixels import to_float
from tap_ros.prediction.batches import make_batch
from tap_ros.prediction.methods import method_fields
from tap_ros.prediction.predictor import load_network, SubgoalPredictor
from tap_ros.prediction.training import kl_share, train
from tap_ros.prediction.training_config import TrainingConfig
from tap_ros.recording.cache import open_recordings
from tap_ros.training import devices
from tap_ros.training.checkpoints import start
from tap_ros.training.devices import Processes
from tap_ros.training.weights import load_tensors, load_weights, save_tensors
import torch

ROOT = Path(__file__).parents[2]


@pytest.fixture
def config(bag, tmp_path):
    return TrainingConfig(
        recordings=(str(bag),), out=str(tmp_path / 'run'), base_width=4, batch_size=4, steps=4,
        warmup=1, margin=1, test_fraction=0.3, threads=1, save_every=2, log_every=1,
        selection='relative')


def weights(config):
    return load_tensors(f'{config.out}/checkpoint.safetensors')[0]


@pytest.mark.parametrize('values', [
    {'precision': 'float32', 'num_targets': 3, 'min_crop': 0.6},
    {'precision': 'bfloat16', 'num_targets': 3, 'min_crop': 0.6},
    {**method_fields('genmin-vae-gan')},
    {**method_fields('fix0.25'), 'mode': 'forward'},
    {**method_fields('genmin4'), 'mode': 'forward', 'recursion': 2},
    {'decoder': 'separate', 'skips': False, 'recursion': 2},
    {**method_fields('genmin-vae'), 'kl_warmup': 0.5, 'posterior_std': 0.1},
    {**method_fields('genmin-vae'), 'posterior': 'frame', 'num_targets': 2}])
def test_two_steps_and_two_more_equal_four(config, tmp_path, values):
    config = replace(config, **values)
    train(config, progress=False)
    interrupted = replace(config, out=str(tmp_path / 'interrupted'))
    train(interrupted, stop_at=2, progress=False)
    halfway = weights(interrupted)
    train(interrupted, progress=False)
    expected, resumed = weights(config), weights(interrupted)
    assert set(expected) == set(resumed)
    for name, tensor in expected.items():
        assert resumed[name].equal(tensor), name
    assert not halfway['network.head.0.weight'].equal(resumed['network.head.0.weight'])


def test_a_training_can_begin_with_the_weights_of_another(config, tmp_path):
    first = train(config, progress=False)
    tuned = replace(config, out=str(tmp_path / 'tuned'), initial_weights=first, seed=1,
                    learning_rate=1e-12, steps=2)
    expected, begun = load_network(first)[0], load_network(train(tuned, progress=False))[0]
    weights = dict(begun.named_parameters())
    for name, tensor in expected.named_parameters():
        assert torch.allclose(weights[name], tensor, atol=1e-6), name
    again = replace(tuned, out=str(tmp_path / 'again'))
    train(again, stop_at=1, progress=False)
    Path(first).unlink()  # once begun, it goes on without them
    train(again, progress=False)


def test_weights_of_another_network_are_no_beginning(config, tmp_path):
    first = train(config, stop_at=1, progress=False)
    other = replace(config, out=str(tmp_path / 'other'), initial_weights=first, base_width=8)
    with pytest.raises(ConfigError, match='base_width 4 instead of 8'):
        train(other, progress=False)
    with pytest.raises(ConfigError, match='skips True instead of False'):
        train(replace(other, base_width=4, skips=False), progress=False)
    assert not (Path(other.out) / 'checkpoint.safetensors').exists()


def test_seed_decides(config, tmp_path):
    train(config, stop_at=1, progress=False)
    other = replace(config, seed=1, out=str(tmp_path / 'other'))
    train(other, stop_at=1, progress=False)
    name = 'network.head.0.weight'
    assert not weights(config)[name].equal(weights(other)[name])


@pytest.mark.parametrize('mode, method', [
    ('bidirectional', 'fix'), ('bidirectional', 'min'), ('bidirectional', 'genmin'),
    ('bidirectional', 'genmin-wo-gan+relative'),
    ('bidirectional', 'genmin-wo-gan+progress'),
    ('bidirectional', 'genmin-vae'), ('bidirectional', 'genmin-vae-gan'), ('forward', 'fix1.00'),
    ('forward', 'genmin2')])
def test_every_method_learns(config, mode, method):
    config = replace(config, mode=mode, **method_fields(method), steps=30, learning_rate=2e-3,
                     new_pixels=True, save_every=1, average_decay=0.0)
    losses = []
    for stop in (1, 30):
        train(replace(config, save_every=stop), stop_at=stop, progress=False)
        with open(f'{config.out}/scores.json') as file:
            losses.append(json.load(file)['loss'])
    assert losses[1] < losses[0]


@pytest.mark.parametrize('values', [
    {**method_fields('genmin'), 'new_pixels': True}, method_fields('genmin-vae-gan')])
def test_compiled_networks_are_trained(config, monkeypatch, values):
    monkeypatch.setattr(torch, 'compile', partial(torch.compile, backend='eager'))
    path = train(replace(config, compile=True, steps=1, **values), progress=False)
    assert load_network(path)[1]['steps'] == 1


def test_several_processes_need_a_gpu_each_and_an_equal_part_of_the_batch(config, monkeypatch):
    monkeypatch.setenv('WORLD_SIZE', '2')
    with pytest.raises(ConfigError, match='device: 2 processes train on a GPU each, not on cpu'):
        train(replace(config, device='cpu'), progress=False)
    with pytest.raises(ConfigError, match='batch_size: 5 episodes cannot be divided among 2'):
        Processes(0, 2).part(5)
    assert [Processes(rank, 2).part(6) for rank in (0, 1)] == [slice(0, 3), slice(3, 6)]


def test_a_run_leaves_what_is_needed_to_repeat_it(config):
    path = train(config, progress=False)
    about = {}
    for name in ('config', 'run', 'scores'):
        with open(f'{config.out}/{name}.json') as file:
            about[name] = json.load(file)
    assert about['config']['learning_rate'] == config.learning_rate
    assert about['run']['steps'] == 4 and len(about['run']['data_hash']) == 64
    assert about['run']['episodes'] + about['run']['held_out'] == 24
    assert about['scores']['loss'] > 0
    values, _, training = load_weights(path, 'predictor')
    assert values['image_size'] == 32 and values['base_width'] == 4
    assert training['scores'] == about['scores']
    assert SubgoalPredictor.load(path).image_size == (32, 32)
    assert list(Path(config.out).glob('events.out.tfevents.*'))


@pytest.mark.parametrize('first, second', [(0.1, 9.0), (9.0, 0.1)])
def test_a_run_goes_on_in_the_precision_that_it_began_with(config, monkeypatch, first, second):
    monkeypatch.setattr(devices, 'bfloat16_gain', lambda: first)
    train(config, stop_at=2, progress=False)
    monkeypatch.setattr(devices, 'bfloat16_gain', lambda: second)
    path = train(config, progress=False)
    expected = replace(config, out=f'{config.out}-expected',
                       precision='float32' if first < 1 else 'bfloat16')
    train(expected, progress=False)
    assert all(weights(config)[name].equal(value) for name, value in weights(expected).items())
    for facts in (load_network(path)[1], json.loads(Path(config.out, 'run.json').read_text())):
        assert facts['precision'] == expected.precision


def test_a_run_of_other_settings_is_not_continued(config):
    train(config, stop_at=2, progress=False)
    with pytest.raises(ConfigError, match='learning_rate=0.001, not 0.1'):
        train(replace(config, learning_rate=0.1), progress=False)


def test_a_finished_run_stays_as_it_is(config):
    train(config, progress=False)
    before = weights(config)
    train(config, progress=False)
    assert all(before[name].equal(tensor) for name, tensor in weights(config).items())


@pytest.mark.parametrize('where', ['save_weights', 'save_checkpoint'])
def test_a_run_that_is_killed_while_it_saves_ends_as_it_would_have(config, monkeypatch, where):
    def killed(*_):
        raise KeyboardInterrupt
    train(config, stop_at=2, progress=False)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(f'tap_ros.training.run.{where}', killed)
        train(config, progress=False)
    train(config, progress=False)
    out = Path(config.out)
    assert json.loads((out / 'run.json').read_text())['steps'] == config.steps
    served = load_weights(out / 'predictor.safetensors', 'predictor')[1]
    for name, tensor in served.items():
        assert weights(config)[f'average.{name}'].equal(tensor), name
    assert not list(out.glob('*.part'))


@pytest.mark.parametrize('change', [
    lambda path: path.write_bytes(path.read_bytes()[:-9]),
    lambda path: path.write_bytes(path.with_name('predictor.safetensors').read_bytes()),
    lambda path: save_tensors(path, {}, load_tensors(path)[1]),
    lambda path: save_tensors(path, load_tensors(path)[0], {'kind': 'checkpoint'})],
    ids=['cut', 'other', 'empty', 'undescribed'])
def test_a_damaged_or_foreign_checkpoint_is_one_line(config, change):
    train(config, stop_at=2, progress=False)
    path = Path(config.out, 'checkpoint.safetensors')
    change(path)
    with pytest.raises(WeightsError, match=str(path)) as error:
        train(config, progress=False)
    assert str(error.value).isprintable()


def test_a_full_disk_is_one_line_and_the_run_goes_on_later(config):
    train(config, stop_at=2, progress=False)
    before = Path(config.out, 'checkpoint.safetensors').read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(StorageError, match=config.out) as error:
            train(config, progress=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(error.value).isprintable()
    assert Path(config.out, 'checkpoint.safetensors').read_bytes() == before
    assert not list(Path(config.out).glob('*.part'))
    train(config, progress=False)
    resumed = weights(config)
    whole = replace(config, out=f'{config.out}-whole')
    train(whole, progress=False)
    assert all(resumed[name].equal(value) for name, value in weights(whole).items())


def test_a_second_training_in_the_same_folder_is_refused(config):
    with only_writer(config.out), pytest.raises(StorageError, match='another process'):
        train(config, progress=False)


def test_a_network_in_use_predicts_as_in_training(config):
    config = replace(config, steps=60, average_decay=0.0, save_every=60, new_pixels=True,
                     decoder='separate', skips=False, **method_fields('genmin-wo-gan'))
    network, _ = load_network(train(config, progress=False))
    store = open_recordings(list(config.recordings), progress=False)
    context = to_float(make_batch(store, range(len(store))).context)
    with torch.no_grad():
        used, trained = network(context).image, network.train()(context).image
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.reset_running_stats()
        without = network.eval()(context).image
    # Batch norm's averages lag behind, but serve far better than none.
    assert (used - trained).abs().mean() < 0.5 * (without - trained).abs().mean()


def test_learning_rate_rises_and_falls():
    state, rates = start(torch.nn.Linear(1, 1), 1e-3, 'cpu'), []
    for state.step in range(1000):
        state.set_rates(1000, 10, 1.0)
        rates.append(state.optimizers[0].param_groups[0]['lr'])
    assert rates[0] < 0.1 and max(rates) == pytest.approx(1, abs=0.01)
    assert rates[-1] == pytest.approx(0.02, abs=0.001)
    assert all(a >= b for a, b in zip(rates[10:], rates[11:]))


def test_the_price_of_z_rises():
    shares = [kl_share(step, 100, 0.4) for step in range(100)]
    assert shares[:41] == [0] * 41 and shares[60] == 0.5 and shares[80:] == [1] * 20
    assert kl_share(0, 100, 0.0) == 1


def test_settings_that_make_no_sense_or_do_nothing_are_refused_by_name(config):
    for values in (
            {'recordings': ()}, {'loss': 'max'}, {'outer_power': 2.0}, {'mode': 'sideways'},
            {'goal_picture': 'none'}, {'steps': 0}, {'margin': -1}, {'test_fraction': 1.5},
            {'fraction': 1.5}, {'beta': 0.0}, {'selection': 'progress', 'mode': 'forward'},
            {'recursion': 2, 'loss': 'fix'}, {'posterior': 'frame', 'latent': 'vae', 'gan': True},
            {'posterior': 'frame'}, {'gan_weight': -1.0}, {'free_nats': -1.0}, {'kl_warmup': 0.6},
            {'posterior_std': 0.0}, {'posterior': 'frame', 'free_nats': 1.0, 'latent': 'vae'},
            # Without z
            {'free_nats': 1.0}, {'kl_warmup': 0.5}, {'posterior_std': 0.1}):
        with pytest.raises(ConfigError, match=next(iter(values))):
            TrainingConfig(**{'recordings': ('bag',), 'out': 'out', **values})
    with pytest.raises(ConfigError, match="device: 'nonsense'"):
        train(replace(config, device='nonsense'), progress=False)


def test_the_command_line_sets_every_field(config, capsys):
    assert main([
        'train', 'predictor', *config.recordings, '--out', config.out, '--steps', '1',
        '--no-flip', '--base-width', '4', '--batch-size', '2', '--loss', 'min',
        '--new-pixels']) == 0
    assert capsys.readouterr().out.strip() == f'{config.out}/predictor.safetensors'
    with open(f'{config.out}/config.json') as file:
        settings = json.load(file)
    assert settings['loss'] == 'min' and settings['new_pixels'] and not settings['flip']


def test_training_on_one_episode_works_without_held_out_ones(config):
    train(replace(config, test_fraction=0.0, steps=1), progress=False)
    with open(f'{config.out}/scores.json') as file:
        assert json.load(file) == {}
    assert torch.isfinite(weights(config)['network.head.0.weight']).all()


def test_training_stops_after_the_minutes_given_and_goes_on(config):
    train(config, minutes=1e-9, progress=False)
    with open(f'{config.out}/run.json') as file:
        assert json.load(file)['steps'] == 1
    train(config, progress=False)
    with open(f'{config.out}/run.json') as file:
        assert json.load(file)['steps'] == 4
