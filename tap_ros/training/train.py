# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train by a recipe: the function `tap_ros.train`, and what the commands `train ...` do."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields, replace
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from tap_ros.errors import ConfigError, TapError
from tap_ros.recording.reading import Reading
from tap_ros.training.recipes import DEFAULT, find_recipe, Model, Recipe, RECIPES
from tap_ros.training.settings import TrainOptions
from tap_ros.weights import find_predictor

Options = TypeVar('Options', bound=TrainOptions)

# Of each model: its settings, a dataclass, and what trains it; torch takes seconds to import.
_TRAINERS = {
    'predictor': ('tap_ros.prediction.training_config:TrainingConfig',
                  'tap_ros.prediction.training:train'),
    'forward': ('tap_ros.planning.forward_training_config:ForwardTrainingConfig',
                'tap_ros.planning.forward_training:train')}


def train(recordings: str | Path | Sequence[str | Path], out: str | Path = '',
          model: Model = 'predictor', recipe: str = '', **settings: Any) -> Path:
    """
    Train a predictor, or the planner's forward model, or go on where a training was interrupted.

        weights = train('bags/push2', 'runs/push2')
        weights = train('bags/mine', 'runs/mine', crop='centre', size=64, steps=5000)
        weights = train('bags/push2', 'runs/try', recipe='debug')

    :param recordings: one or several: bag folders, folders of these, or .mcap files.
    :param out: the run's folder; by default runs/predictor or runs/forward.
    :param model: 'predictor' or 'forward'.
    :param recipe: its name in training/recipes.py; by default that of the task that the
        recordings name, else with marks 'foreign', else push2's.
    :param settings: other settings than the recipe's: fields of TrainingConfig, or of
        ForwardTrainingConfig. Initial weights bring the network's shape and the pictures' size.
    :return: path of the weights file.
    :raises ConfigError: for a model, recipe or setting that is unknown or cannot be trained with.
    :raises TapError: for recordings that cannot be used, a damaged checkpoint, a full disk.
    """
    if model not in _TRAINERS:
        raise ConfigError(f'model {model!r} is unknown; valid: {", ".join(_TRAINERS)}')
    paths = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    bags = tuple(str(path) for path in paths)
    config_class, function = _trainer(model)
    known = [field.name for field in fields(config_class)]
    for name in settings:
        if name not in known:
            near = get_close_matches(name, known, 1)
            raise ConfigError(f'setting {name!r} of a {model} is unknown'
                              + (f'; did you mean {near[0]!r}?' if near else ''))
    if isinstance(settings.get('held_out'), str | Path):
        settings['held_out'] = (str(settings['held_out']),)
    for name in settings.keys() & {'marks', 'initial_weights'}:
        settings[name] = str(settings[name])
    settings = {**shape_of(model, settings), **settings}
    chosen = find_recipe(model, recipe or recipe_of(model, bags, settings))
    return Path(function(config_class(recordings=bags, out=str(out or f'runs/{model}'), **{
        **_chosen_settings(chosen, settings), **settings})))


def _trainer(model: str) -> list[Any]:
    """Return the class of a model's settings, and the function that trains it."""
    return [getattr(import_module(module), name) for module, name in (
        place.split(':') for place in _TRAINERS[model])]


def shape_of(model: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the settings that make a network of the shape that the initial weights have.

    :param model: 'predictor' or 'forward'; settings: of the training.
    :return: dict; empty without them, for another model than a predictor, and where nothing can
        be read, which the training will say.
    """
    weights = settings.get('initial_weights')
    if model != 'predictor' or not weights:
        return {}
    with suppress(TapError):
        from tap_ros.training.weights import load_weights  # here: torch takes seconds to import
        config = {'decoder': 'separate', 'skips': False,  # as files that do not tell have them
                  **load_weights(find_predictor(weights), 'predictor')[0]}
        return {'size': config['image_size'], **{name: config[name] for name in (
            'base_width', 'new_pixels', 'decoder', 'skips')}}
    return {}


def recipe_of(model: str, recordings: Sequence[str], settings: Mapping[str, Any]) -> str:
    """
    Name the recipe for recordings: that of the task of their first episode, if there is one.

    For others with marks it is 'foreign'.

    :param model: 'predictor' or 'forward'.
    :param recordings: paths.
    :param settings: of the training; those of Reading say how they are read.
    :return: name of a recipe; the default one where no recipe has the task's name, or the
        recordings cannot be read, which the training will say.
    """
    task = ''
    with suppress(TapError):
        from tap_ros.recording.bags import check_first_picture
        from tap_ros.recording.cache import open_recordings  # --help does without numpy
        reading = Reading(**{field.name: settings[field.name] for field in fields(Reading)
                             if field.name in settings})
        check_first_picture(recordings, reading, f'the {model}')
        task = open_recordings(list(recordings), reading=reading)[0].task
    if task in RECIPES[model]:
        return task
    return 'foreign' if settings.get('marks') else DEFAULT[model]


def with_recipe(model: Model, args: Options) -> Options:
    """
    Put the settings of the recipe into the options of a command.

    :param model: 'predictor' or 'forward'.
    :param args: options; their fields beside `recipe` are dataclasses of settings.
    """
    given = settings_of(args)
    if not given['recordings']:
        raise ConfigError('missing: BAG; name the recordings, or see --help')
    shape = shape_of(model, given)
    reading = given | {'size': given['size'] or shape.get('size', 0)}
    chosen = find_recipe(model, args.recipe or recipe_of(model, given['recordings'], reading))
    wanted = {**_chosen_settings(chosen, given), **shape}
    changed: dict[str, Any] = {
        name: replace(part, **{key: wanted[key] for key in asdict(part).keys() & wanted})
        for name, part in vars(args).items() if not isinstance(part, str | bool)}
    return replace(args, **changed)


def _chosen_settings(recipe: Recipe, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings of a recipe; where marks are given, they choose what is matched."""
    return {**recipe.settings, 'selection': 'marks'} if given.get('marks') else recipe.settings


def settings_of(args: TrainOptions) -> dict[str, Any]:
    """Return the settings of all parts of a command's options, by name."""
    return {name: value for part in vars(args).values() if not isinstance(part, str | bool)
            for name, value in asdict(part).items()}


def run_training(model: Model, args: TrainOptions) -> None:
    """Train with the options' settings, and print where the weights are."""
    config_class, function = _trainer(model)
    settings = settings_of(args)
    print(function(config_class(**{**settings, 'out': settings['out'] or f'runs/{model}'})))
