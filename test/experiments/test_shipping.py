# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command that makes the shipped weights again: real recordings, a short training, a card."""

from pathlib import Path

from experiments.weights import command
import numpy as np
import pytest
from tap_ros.__main__ import main
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.training.predictor_config import RECIPES, TrainingConfig
from tap_ros.weights import PREDICTORS

TINY = TrainingConfig(
    recordings=(), selection='absolute', steps=2, batch_size=2, base_width=4, goal_picture='last',
    latent='vae', test_fraction=0.5)
RECORDED = 'grasp', {'grasp': {'episodes': 6},
                     'light': {'episodes': 2, 'appearance': 'lighter_table'}}


@pytest.fixture
def places(tmp_path, monkeypatch):
    monkeypatch.setitem(RECIPES, 'tiny', TINY)
    monkeypatch.setattr(command, 'FRESH_EPISODES', 3)
    return {'bags': str(tmp_path / 'bags'), 'runs': str(tmp_path / 'runs'),
            'out': str(tmp_path / 'out')}


def test_weights_are_made_from_nothing_and_their_card_says_how(
        places, monkeypatch, capfd):
    monkeypatch.setitem(command.SHIPPED, 'tiny', RECORDED)
    options = command.Options(only=('tiny',), **places)
    command.run(options)
    file, source = (Path(places['out'], 'predictor_tiny.safetensors'),
                    Path(places['runs'], 'tiny', 'predictor.safetensors'))
    assert file.stat().st_size < 0.6 * source.stat().st_size
    picture = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    shipped, trained = (SubgoalPredictor.load(path).predict(picture, picture[::-1].copy())[0]
                        for path in (file, source))
    assert np.abs(shipped.image.astype(int) - trained.image).max() <= 1
    card = file.with_suffix('.md').read_text()
    for text in ('a subgoal picture',
                 'python -m tap_ros collect --task grasp --episodes 6 --out bags/grasp',
                 'The best of 100 samples', 'prediction (z = 0)',
                 'python -m tap_ros collect --task grasp --episodes 3 --seed 900000',
                 '--episodes 2 --appearance lighter_table --out bags/light',
                 'python -m tap_ros train predictor bags/grasp bags/light --recipe tiny',
                 '; recipe: tiny (',
                 'copy-start', 'last frame', f'({file.stem}.png)', '3 scenes'):
        assert text in card
    assert file.with_suffix('.png').read_bytes().startswith(b'\x89PNG')

    before = source.stat().st_mtime_ns
    command.run(options)  # nothing is collected or trained twice
    assert source.stat().st_mtime_ns == before


def test_the_list_is_of_commands_that_exist(places, capsys):
    assert set(command.SHIPPED) == PREDICTORS.keys()
    command.run(command.Options(list=True, **places))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == sum(
        2 + len(recordings) for _, recordings in command.SHIPPED.values())
    assert not Path(places['runs']).exists()
    for line in lines:
        words = line.split()[3:]
        with pytest.raises(SystemExit) as ended:
            main([*words, '--help'])
        assert ended.value.code == 0
