# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Laws of every training run: whatever ends it, it goes on to the same result."""

from dataclasses import replace
import json
from pathlib import Path
import resource
import shutil
import signal

import pytest
from tap_ros.__main__ import main
from tap_ros.base.errors import ConfigError, StorageError, WeightsError
from tap_ros.base.files import only_writer
from tap_ros.training.checkpoints import start, TrainingState, WARMUP
from tap_ros.training.predictor import train
from tap_ros.training.predictor_config import TrainingConfig
from tap_ros.weights.weights import load_tensors, save_tensors
import torch

SAMPLE = Path(__file__).parents[2] / 'bags' / 'sample_push2'
CONFIG = TrainingConfig(
    recordings=(str(SAMPLE),), out='', base_width=4, batch_size=2, steps=4, threads=1,
    test_fraction=0.3, save_every=2, precision='float32', log_every=1, margin=1)


@pytest.fixture(scope='module')
def runs(tmp_path_factory):
    """Train twice, the second time half of the way; return the folders."""
    folder = tmp_path_factory.mktemp('runs')
    for name, stop in (('whole', 4), ('half', 2)):
        train(replace(CONFIG, out=str(folder / name)), stop_at=stop, progress=False)
    return folder


@pytest.fixture
def half(runs, tmp_path):
    """Return the settings of a copy of the run that is half done."""
    shutil.copytree(runs / 'half', tmp_path / 'run')
    return replace(CONFIG, out=str(tmp_path / 'run'))


def same(config, runs):
    """Tell whether a run has ended as the whole one did."""
    found, expected = (load_tensors(Path(folder, 'checkpoint.safetensors'))[0]
                       for folder in (config.out, runs / 'whole'))
    shipped = load_tensors(Path(config.out, 'predictor.safetensors'))[0]
    return all(found[name].equal(value) for name, value in expected.items()) and all(
        expected[f'average.{name}'].equal(value) for name, value in shipped.items())


@pytest.mark.parametrize('where', ['save_weights', 'save_checkpoint'])
def test_a_run_that_is_killed_while_it_saves_ends_as_it_would_have(
        half, runs, monkeypatch, where):
    def killed(*_):
        raise KeyboardInterrupt
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(f'tap_ros.training.run.{where}', killed)
        train(half, progress=False)
    train(half, progress=False)
    assert same(half, runs) and not list(Path(half.out).glob('*.part'))


def test_ctrl_c_saves_what_a_training_has(half, runs, monkeypatch, capsys):
    def interrupted(state, *rates):
        signal.raise_signal(signal.SIGINT)
        set_rates(state, *rates)

    set_rates = TrainingState.set_rates
    with monkeypatch.context() as patch:
        patch.setattr(TrainingState, 'set_rates', interrupted)
        assert main([
            'train', 'predictor', str(SAMPLE), '--out', half.out, '--base-width', '4',
            '--batch-size', '2', '--steps', '4', '--threads', '1', '--test-fraction', '0.3',
            '--save-every', '2', '--precision', 'float32', '--margin', '1']) == 130
    out, told = capsys.readouterr()
    assert out == '' and '3 of 4 steps are saved' in told
    assert load_tensors(Path(half.out, 'predictor.safetensors'))[1]['training']['steps'] == 3
    train(half, progress=False)
    assert same(half, runs)


@pytest.mark.parametrize('change', [
    lambda path: path.write_bytes(path.read_bytes()[:-9]),
    lambda path: path.write_bytes(path.with_name('predictor.safetensors').read_bytes()),
    lambda path: save_tensors(path, {}, load_tensors(path)[1])], ids=['cut', 'other', 'empty'])
def test_a_damaged_or_foreign_checkpoint_is_one_line(half, change):
    path = Path(half.out, 'checkpoint.safetensors')
    change(path)
    with pytest.raises(WeightsError, match=str(path)) as error:
        train(half, progress=False)
    assert str(error.value).isprintable()


def test_a_full_disk_is_one_line_and_the_run_goes_on_later(half, runs):
    before = Path(half.out, 'checkpoint.safetensors').read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(StorageError, match=half.out) as error:
            train(half, progress=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(error.value).isprintable()
    assert Path(half.out, 'checkpoint.safetensors').read_bytes() == before
    assert not list(Path(half.out).glob('*.part'))
    train(half, progress=False)
    assert same(half, runs)


def test_a_run_of_other_settings_or_of_another_process_is_not_continued(half):
    with pytest.raises(ConfigError, match='learning_rate=0.001, not 0.1'):
        train(replace(half, learning_rate=0.1), progress=False)
    with only_writer(half.out), pytest.raises(StorageError, match='another process'):
        train(half, progress=False)
    path = Path(half.out, 'checkpoint.safetensors')
    tensors, about = load_tensors(path)
    save_tensors(path, tensors, {**about, 'settings': {**about['settings'], 'flip': True}})
    with pytest.raises(ConfigError, match='made by another version of tap_ros'):
        train(half, progress=False)


def test_patience_keeps_the_best_weights_and_ends_when_none_better_come(tmp_path, monkeypatch):
    scores = {1: 3.0, 2: 1.0, 3: 2.0, 4: 2.0, 5: 0.5}
    monkeypatch.setattr('tap_ros.training.predictor._score', lambda run, _: {
        'relative': scores.get(run.state.step, 1.0)})
    patient = replace(CONFIG, patience=2, steps=9, save_every=1)
    held = {}
    for name, stops in (('whole', (9,)), ('parts', (1, 2, 3, 9, 9))):
        config = replace(patient, out=str(tmp_path / name))
        for stop in stops:
            def note(step, config=config):
                if step > 1:
                    held[step] = load_average(config)

            train(config, stop_at=stop, progress=False, after_step=note)
        about = json.loads(Path(config.out, 'run.json').read_text())
        assert (about['steps'], about['best_step']) == (4, 2)
        shipped = load_tensors(Path(config.out, 'predictor.safetensors'))[0]
        assert all(shipped[name].equal(value) for name, value in held[3].items())
        assert not shipped['head.0.weight'].equal(held[4]['head.0.weight'])
    with pytest.raises(ConfigError, match='patience'):
        train(replace(patient, out=str(tmp_path / 'none'), test_fraction=0), progress=False)


def load_average(config):
    """Return the averaged weights of the checkpoint before this step."""
    tensors = load_tensors(Path(config.out, 'checkpoint.safetensors'))[0]
    return {name[8:]: value for name, value in tensors.items() if name.startswith('average.')}


def test_learning_rate_rises_and_falls_and_the_average_moves_fast_at_first():
    state, rates = start(torch.nn.Linear(3, 2), 1.0, 'cpu', 0.9), []
    for state.step in range(10000):
        state.set_rates(10000)
        rates.append(state.optimizers[0].param_groups[0]['lr'])
    assert rates[0] < 0.1 and max(rates) == pytest.approx(1, abs=0.01)
    assert rates[-1] == pytest.approx(0.02, abs=0.001)
    assert all(a >= b for a, b in zip(rates[WARMUP:], rates[WARMUP + 1:]))
    for state.step, stays in ((0, 0.1), (8, 0.5), (10**6, 0.9)):
        before = state.average.weight.clone()
        with torch.no_grad():
            state.network.weight.copy_(before + 1)
        state.update_average()
        assert torch.allclose(state.average.weight, before + (1 - stays), atol=1e-6)
