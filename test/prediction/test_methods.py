# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of methods, settings of earlier versions, and recipes of the shipped weights."""

from dataclasses import asdict
import json
from pathlib import Path
import re

import pytest
import tap_ros
from tap_ros.cli import read
from tap_ros.errors import ConfigError
from tap_ros.planning.forward_training_config import ForwardTrainingConfig
from tap_ros.prediction.methods import method_fields, todays_settings
from tap_ros.prediction.training_config import DEFAULTS, TrainingConfig
from tap_ros.training.recipes import DEFAULT, find_recipe, RECIPES
from tap_ros.training.settings import FREE
from tap_ros.training.weights import load_tensors
from tap_ros.weights import FORWARD_MODEL, PREDICTORS

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / 'bags' / 'sample_push2'


def test_names_of_the_paper_and_of_every_result_are_read_and_made():
    stored = [json.loads(path.read_text()) for path in ROOT.glob('docs/results/runs/*/*.json')]
    assert len(stored) > 100
    for name, mode in {(run['method'], run['mode']) for run in stored}:
        config = TrainingConfig(('x',), 'x', mode=mode, **method_fields(name))
        assert method_fields(config.method) == method_fields(name)
    assert method_fields('genmin2-vae-gan+relative') == {
        'loss': 'genmin', 'selection': 'relative', 'gan': True, 'latent': 'vae', 'fraction': 0.5,
        'beta': 2.0}
    assert todays_settings({'method': 'min', 'bell_edge': 2 / 3, 'match_temperature': 1.0}) == {
        **method_fields('min'), 'match_temperature': 1.0}  # what is gone keeps its name
    for name in ('', 'min2', 'genmin-gan', 'fix+relative', 'genmin+reach'):
        with pytest.raises(ConfigError, match='method'):
            method_fields(name)


def trained_settings(path):
    """Return what weights were trained with, without places and devices, as today's fields."""
    settings = todays_settings(load_tensors(path)[1]['training']['settings'])
    return {name: value for name, value in settings.items() if name not in FREE}


@pytest.mark.parametrize('name', PREDICTORS)
def test_card_recipe_and_weights_agree(name):
    settings = {**DEFAULTS, **trained_settings(PREDICTORS[name])}
    # Its folder was given before shipped weights had names.
    settings['initial_weights'] = re.sub(
        r'.*/predictor_(.*)\.safetensors', r'\1', settings['initial_weights'])
    recipe = asdict(TrainingConfig(('x',), 'x', **find_recipe('predictor', name).settings))
    assert {key: recipe[key] for key in settings if key not in FREE} == {
        key: value for key, value in settings.items() if key not in FREE}
    card = PREDICTORS[name].with_suffix('.md').read_text()
    assert f'recipe: {name} ' in card and f' --recipe {name} ' in card
    config = load_tensors(PREDICTORS[name])[1]['config']
    assert config['latent_size'] == (recipe['latent_size'] if recipe['latent'] == 'vae' else 0)
    assert all(config[key] == recipe[key] for key in (
        'base_width', 'new_pixels', 'decoder', 'skips'))


def test_every_recipe_can_be_trained_and_a_typo_is_answered_with_the_nearest():
    settings = trained_settings(FORWARD_MODEL)
    assert settings == {name: value for name, value in asdict(ForwardTrainingConfig(
        ('x',), 'x')).items() if name in settings}
    for model, kind in (('predictor', TrainingConfig), ('forward', ForwardTrainingConfig)):
        assert DEFAULT[model] in RECIPES[model] and not find_recipe(
            model, DEFAULT[model]).settings  # the defaults are the recipe
        for recipe in RECIPES[model].values():
            kind(('x',), 'x', **recipe.settings)
    with pytest.raises(ConfigError, match="'pusch2' is unknown; did you mean 'push2'"):
        find_recipe('predictor', 'pusch2')


def test_without_options_the_sample_is_trained_by_its_tasks_recipe(tmp_path):
    asked = read(['train', 'predictor', str(SAMPLE)])[1]
    named = read(['train', 'predictor', str(SAMPLE), '--recipe', 'push2'])[1]
    assert vars(asked) | {'recipe': 'push2'} == vars(named)
    order = read(['train', 'predictor', str(SAMPLE), '--recipe', 'order2', '--steps', '3'])[1]
    assert order.objective.selection == 'relative' and order.optimizer.steps == 3

    marked = read(['train', 'predictor', str(tmp_path), '--marks', 'x'])[1]  # no task of ours
    assert (marked.objective.selection, marked.data.margin, marked.network.new_pixels) == (
        'marks', 1, True)

    weights = tap_ros.train(SAMPLE, tmp_path / 'run', recipe='debug', steps=2)
    trained = load_tensors(weights)[1]['training']['settings']
    expected = TrainingConfig((str(SAMPLE),), str(tmp_path / 'run'), **{
        **RECIPES['predictor']['debug'].settings, 'steps': 2})
    assert trained == json.loads(json.dumps(asdict(expected)))
    with pytest.raises(ConfigError, match="'step' .* did you mean 'steps'"):
        tap_ros.train(SAMPLE, tmp_path / 'other', step=2)
