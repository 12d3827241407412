# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of methods, and recipes of the shipped weights."""

from dataclasses import asdict, replace
import json
from pathlib import Path

from experiments.paper.methods import method_fields
import pytest
import tap_ros
from tap_ros.__main__ import LINE
from tap_ros.apps.cli import read
from tap_ros.base.errors import ConfigError
from tap_ros.training.forward_config import RECIPES as FORWARD_RECIPES
from tap_ros.training.objective import LATENT_SIZE
from tap_ros.training.predictor_config import RECIPES, TrainingConfig
from tap_ros.training.run_config import FREE
from tap_ros.weights import FORWARD_MODEL, PREDICTORS
from tap_ros.weights.weights import load_tensors

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / 'bags' / 'sample_push2'


def test_names_of_the_paper_and_of_every_result_are_read_and_made():
    stored = [json.loads(path.read_text()) for path in ROOT.glob('docs/results/runs/*/*.json')]
    assert len(stored) > 100
    for name, mode in {(run['method'], run['mode']) for run in stored}:
        config = TrainingConfig(recordings=('x',), mode=mode, **method_fields(name))
        assert method_fields(config.method) == method_fields(name)
    assert method_fields('genmin2-vae-gan+relative') == {
        'loss': 'genmin', 'selection': 'relative', 'gan': True, 'latent': 'vae', 'fraction': 0.5,
        'beta': 2.0}
    for name in ('', 'min2', 'genmin-gan', 'fix+relative', 'genmin+reach'):
        with pytest.raises(ConfigError, match='method'):
            method_fields(name)


def trained_settings(path):
    """Return what weights were trained with, without places and devices."""
    settings = load_tensors(path)[1]['training']['settings']
    return {name: value for name, value in settings.items() if name not in FREE}


def settings_of(recipe):
    """Return the settings of a recipe, likewise."""
    settings = json.loads(json.dumps(asdict(recipe)))  # no tuples
    return {name: value for name, value in settings.items() if name not in FREE}


@pytest.mark.parametrize('name', PREDICTORS)
def test_card_recipe_and_weights_agree(name):
    recipe, config = RECIPES[name], load_tensors(PREDICTORS[name])[1]['config']
    later = settings_of(RECIPES['push2'])  # what came later is at its default
    trained = trained_settings(PREDICTORS[name])
    split = trained.pop('split', 'crc32')  # of the command that ships, not of the recipe
    assert later | trained == settings_of(recipe)
    card = PREDICTORS[name].with_suffix('.md').read_text()
    assert f' --split {split} ' in card
    assert f'recipe: {name} ' in card and f' --recipe {name} ' in card
    assert config['latent_size'] == (LATENT_SIZE if recipe.latent == 'vae' else 0)
    assert all(config[key] == getattr(recipe, key) for key in (
        'base_width', 'new_pixels', 'decoder', 'skips'))


def test_every_recipe_can_be_trained_and_a_typo_is_answered_with_the_nearest():
    usual = settings_of(FORWARD_RECIPES['push'])
    assert usual | trained_settings(FORWARD_MODEL) == usual
    for recipe in (*RECIPES.values(), *FORWARD_RECIPES.values()):
        replace(recipe, recordings=('x',)).check()
    with pytest.raises(ConfigError, match="'pusch2' is unknown; did you mean 'push2'"):
        tap_ros.train(SAMPLE, recipe='pusch2')


def options_of(*words):
    """Return the options of a training by words."""
    return read(LINE, ['train', 'predictor', *words])[1]


def test_without_options_the_sample_is_trained_by_its_tasks_recipe(tmp_path):
    asked = options_of(str(SAMPLE))
    named = options_of(str(SAMPLE), '--recipe', 'push2')
    assert asked == named == replace(RECIPES['push2'], recordings=(str(SAMPLE),), recipe='push2')
    order = options_of(str(SAMPLE), '--recipe', 'order2', '--steps', '3')
    assert order.selection == 'relative' and order.steps == 3

    marked = options_of(str(tmp_path), '--marks', 'x')  # no task of ours
    assert (marked.selection, marked.margin, marked.new_pixels) == ('marks', 1, True)

    weights = tap_ros.train(SAMPLE, tmp_path / 'run', recipe='debug', steps=2)
    trained = load_tensors(weights)[1]['training']['settings']
    expected = replace(RECIPES['debug'], recordings=(str(SAMPLE),), recipe='debug',
                       out=str(tmp_path / 'run'), steps=2)
    assert trained == json.loads(json.dumps(asdict(expected)))
    with pytest.raises(ConfigError, match="'step' .* did you mean 'steps'"):
        tap_ros.train(SAMPLE, tmp_path / 'other', step=2)
