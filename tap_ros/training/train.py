# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train by a recipe: the function `tap_ros.train`, and what the commands share."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

from tap_ros.errors import ConfigError, TapError
from tap_ros.recording.reading import Reading
from tap_ros.training.recipes import DEFAULT, find_recipe, Model, RECIPES

# Of each model: its settings, a dataclass, and what trains it.
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
        recordings name, else push2's.
    :param settings: other settings than the recipe's: fields of TrainingConfig, or of
        ForwardTrainingConfig.
    :return: path of the weights file.
    :raises ConfigError: for a model, recipe or setting that is unknown or cannot be trained with.
    :raises TapError: for recordings that cannot be used, a damaged checkpoint, a full disk.
    """
    if model not in _TRAINERS:
        raise ConfigError(f'model {model!r} is unknown; valid: {", ".join(_TRAINERS)}')
    paths = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    bags = tuple(str(path) for path in paths)
    config_class, function = map(_imported, _TRAINERS[model])
    known = [field.name for field in fields(config_class)]
    for name in settings:
        if name not in known:
            near = get_close_matches(name, known, 1)
            raise ConfigError(f'setting {name!r} of a {model} is unknown'
                              + (f'; did you mean {near[0]!r}?' if near else ''))
    if recipe:
        chosen = recipe
    else:
        chosen = recipe_of(model, bags, Reading(**{
            field.name: settings[field.name] for field in fields(Reading)
            if field.name in settings}))
    values = {**find_recipe(model, chosen).settings, **settings}
    return Path(function(config_class(
        recordings=bags, out=str(out or f'runs/{model}'), **values)))


def recipe_of(model: str, recordings: Sequence[str], reading: Reading) -> str:
    """
    Name the recipe for recordings: that of the task of their first episode, if there is one.

    :param model: 'predictor' or 'forward'.
    :param recordings: paths.
    :param reading: how they are read.
    :return: name of a recipe; the default one where no recipe has the task's name, or the
        recordings cannot be read, which the training will say.
    """
    task = ''
    with suppress(TapError):
        from tap_ros.recording.bags import check_first_picture
        from tap_ros.recording.cache import open_recordings  # --help does without numpy
        check_first_picture(tuple(recordings), reading, f'the {model}')
        task = open_recordings(list(recordings), reading=reading)[0].task
    return task if task in RECIPES[model] else DEFAULT[model]


def _imported(place: str) -> Any:
    """Import 'module:attribute'; a training needs torch, which takes seconds."""
    module, _, name = place.partition(':')
    return getattr(import_module(module), name)
