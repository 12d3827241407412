# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command that makes the shipped weights again: real recordings, a short training, a card."""

from dataclasses import fields, replace
from pathlib import Path

from experiments.weights import command
from experiments.weights.card import found
import numpy as np
import pytest
from tap_ros.cli import main
from tap_ros.evaluation.prediction import EpisodeScores
from tap_ros.prediction.predictor import SubgoalPredictor
from tap_ros.training.recipes import Recipe, RECIPES
from tap_ros.weights import PREDICTORS

TINY = Recipe({'selection': 'absolute', 'steps': 2, 'batch_size': 2, 'base_width': 4,
               'goal_picture': 'last'},
              'grasp', {'grasp': {'episodes': 30},
                        'light': {'episodes': 2, 'appearance': 'lighter_table'}})


@pytest.fixture
def places(tmp_path, monkeypatch):
    monkeypatch.setitem(RECIPES['predictor'], 'tiny', TINY)
    monkeypatch.setattr(command, 'FRESH_EPISODES', 3)
    return {'bags': str(tmp_path / 'bags'), 'runs': str(tmp_path / 'runs'),
            'out': str(tmp_path / 'out')}


def test_weights_are_made_from_nothing_and_their_card_says_how(places, capfd):
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
                 'python -m tap_ros collect --task grasp --episodes 30 --out bags/grasp',
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


def test_a_card_says_what_samples_are_worth_and_that_no_goal_is_given(
        places, monkeypatch, capfd):
    monkeypatch.setitem(RECIPES['predictor'], 'tiny', replace(
        TINY, task='push2', recordings={'push2': {'episodes': 30}},
        settings={**TINY.settings, 'latent': 'vae', 'mode': 'forward'}))
    command.run(command.Options(only=('tiny',), **places))
    card = Path(places['out'], 'predictor_tiny.md').read_text()
    for text in ('a later picture from a start picture alone', ' weights:=tiny',
                 'The best of 100 samples', 'Samples place an object', 'prediction (z = 0)',
                 'goal picture none', '| none | copy-start |'):
        assert text in card, text
    assert 'arm elsewhere' not in card and 'copy-goal' not in card


def test_the_list_is_of_commands_that_exist(places, capsys):
    command.run(command.Options(list=True, **places))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == sum(
        2 + len(RECIPES['predictor'][name].recordings) for name in command.SHIPPED)
    assert not Path(places['runs']).exists()
    for line in lines:
        words = line.split()[3:]
        with pytest.raises(SystemExit) as ended:
            main([*words, '--help'])
        assert ended.value.code == 0


def test_success_is_a_bottleneck_or_hand_and_objects():
    nothing = EpisodeScores(**{field.name: np.full(3, np.nan) for field in fields(EpisodeScores)})
    pushed = replace(nothing, bottleneck=np.array([1.0, 2.5, np.nan]))
    assert found(pushed).tolist() == [True, False, False]
    held = replace(nothing, hand=np.array([0.9, 0.9, 0.2]), objects=np.array([0.9, 0.2, 0.9]))
    assert found(held).tolist() == [True, False, False]


def test_recipes_are_of_shipped_weights():
    assert set(command.SHIPPED) == PREDICTORS.keys()
